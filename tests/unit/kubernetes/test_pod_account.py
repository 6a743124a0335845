"""In a pod the account's token is followed as the kubelet renews it, and missing parts are reported."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from kubernetes.aio.client import Configuration

from wayside.kubernetes import connection
from wayside.kubernetes.connection import AccountError, use_pod_account


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "fd00::1")
    monkeypatch.setenv("KUBERNETES_SERVICE_PORT", "443")
    monkeypatch.setattr(connection, "_READ_EVERY", 0.0)
    (tmp_path / "ca.crt").write_text("certificate")
    (tmp_path / "token").write_text("first\n")
    return tmp_path


def token(configuration: Configuration) -> str | None:
    return asyncio.run(configuration.get_api_key_with_prefix("BearerToken", alias="authorization"))


def test_a_renewed_token_is_used_from_the_next_request_on(folder: Path) -> None:
    configuration = Configuration()
    use_pod_account(configuration, folder)
    assert configuration.host == "https://[fd00::1]:443"
    assert token(configuration) == "Bearer first"
    (folder / "token").write_text("second")
    assert token(configuration) == "Bearer second"


def test_while_the_file_is_away_the_last_token_serves_and_that_is_reported_once(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    configuration = Configuration()
    use_pod_account(configuration, folder)
    (folder / "token").unlink()
    assert [token(configuration) for _ in range(3)] == ["Bearer first"] * 3
    assert len([each for each in caplog.messages if "using the previous token" in each]) == 1
    (folder / "token").write_text("second")
    assert token(configuration) == "Bearer second"


@pytest.mark.parametrize(("file", "text"), [("token", ""), ("token", None), ("ca.crt", ""), ("ca.crt", None)])
def test_a_missing_file_is_named(folder: Path, file: str, text: str | None) -> None:
    (folder / file).unlink()
    if text is not None:
        (folder / file).write_text(text)
    with pytest.raises(AccountError, match=file):
        use_pod_account(Configuration(), folder)


def test_an_environment_outside_a_pod_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KUBERNETES_SERVICE_PORT")
    with pytest.raises(AccountError, match="KUBERNETES_SERVICE_PORT"):
        use_pod_account(Configuration(), folder)
