"""A kubeconfig that cannot be used is reported in one line, with its file and the remedy."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from wayside.kubernetes.connection import ConfigurationError, load_configuration

VALID = """
apiVersion: v1
kind: Config
current-context: here
clusters: [{name: here, cluster: {server: "https://127.0.0.1:6443"}}]
contexts: [{name: here, context: {cluster: here, user: me}}]
users: [{name: me, user: {token: secret}}]
"""


@pytest.fixture(autouse=True)
def outside_a_pod(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)


def test_the_server_is_that_of_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "config").write_text(VALID)
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
    assert asyncio.run(load_configuration()).host == "https://127.0.0.1:6443"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "there is no such file"),
        (b"\xff\xfe\x00", "it is not UTF-8 text"),
        (b"a: [b", "it is not YAML"),
        (b"", "is not a kubeconfig"),
        (b"- 1", "is not a kubeconfig"),
        (b"current-context: x", "Invalid kube-config"),
        (VALID.replace("server:", "certificate-authority: /nope, server:").encode(), "/nope"),
    ],
)
def test_an_unusable_kubeconfig_is_reported_with_file_reason_and_remedy(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, content: bytes | None, reason: str
) -> None:
    file = tmp_path / "config"
    if content is not None:
        file.write_bytes(content)
    monkeypatch.setenv("KUBECONFIG", str(file))
    with pytest.raises(ConfigurationError) as caught:
        asyncio.run(load_configuration())
    reported = str(caught.value)
    assert reported.startswith(f"kubeconfig {file}: ")
    assert reason in reported
    assert "set KUBECONFIG to a kubeconfig file" in reported
    assert "\n" not in reported


def test_without_any_file_the_default_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("KUBECONFIG", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(ConfigurationError, match=r"kubeconfig ~/\.kube/config: there is no such file: set KUBECONFIG"):
        asyncio.run(load_configuration())
