"""The sources of the programs of the control plane."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from tests.cluster.binaries import PACKAGES, BinariesUnavailableError, cache_folder, ensure_binaries
from tests.cluster.toolchain import version_of
from tests.patience import PATIENCE


def program(path: Path, text: str = "#!/bin/sh\n") -> Path:
    path.write_text(text)
    path.chmod(0o755)
    return path


@pytest.fixture
def console() -> Console:
    return Console(file=io.StringIO(), width=200)


def test_programs_in_kubebuilder_assets_win_and_only_the_rest_comes_from_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, console: Console
) -> None:
    ours = ensure_binaries(console)
    etcd, api_server = (program(tmp_path / name) for name in ("etcd", "kube-apiserver"))
    monkeypatch.setenv("KUBEBUILDER_ASSETS", str(tmp_path))

    found = ensure_binaries(console)

    assert (found.etcd, found.kube_apiserver) == (etcd, api_server)
    assert (found.kube_controller_manager, found.kubectl) == (ours.kube_controller_manager, ours.kubectl)


def test_kubebuilder_assets_without_a_program_is_reported_before_anything_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program(tmp_path / "etcd")
    monkeypatch.setenv("KUBEBUILDER_ASSETS", str(tmp_path))
    with pytest.raises(BinariesUnavailableError, match=f"KUBEBUILDER_ASSETS={tmp_path} has no kube-apiserver: "):
        ensure_binaries()


def test_kubebuilder_assets_that_is_no_folder_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KUBEBUILDER_ASSETS", "/nowhere/at/all")
    with pytest.raises(BinariesUnavailableError, match="KUBEBUILDER_ASSETS=/nowhere/at/all is not a folder"):
        ensure_binaries()


def test_a_failed_build_shows_the_compiler_output_and_leaves_no_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, console: Console
) -> None:
    go = tmp_path / "bin"
    go.mkdir()
    program(go / "go", '#!/bin/sh\n[ "$1" = env ] && echo go1.99.0 && exit\necho no space left on device\nexit 1\n')
    monkeypatch.setenv("PATH", str(go), prepend=os.pathsep)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("KUBEBUILDER_ASSETS", raising=False)

    with pytest.raises(BinariesUnavailableError, match=r"(?s)building etcd, .* failed.*no space left on device"):
        ensure_binaries(console)

    assert [path.name for path in cache_folder().iterdir()] == [".lock"]


def test_two_builds_of_one_cache_build_each_program_once(tmp_path: Path) -> None:
    go = tmp_path / "bin"
    go.mkdir()
    record = tmp_path / "record"
    build = f"""while [ "$1" != -o ]; do shift; done
out=$2; shift 2
for package; do
  case $out in */) to=$out${{package##*/}};; *) to=$out;; esac
  echo built $package >> {record}; echo program > $to
done
"""
    program(go / "go", f'#!/bin/sh\n[ "$1" = env ] && echo go1.99.0 && exit\n{build}')
    environment = os.environ | {"PATH": f"{go}{os.pathsep}{os.environ['PATH']}", "XDG_CACHE_HOME": str(tmp_path / "c")}
    environment.pop("KUBEBUILDER_ASSETS", None)

    command = [sys.executable, "-m", "tests.cluster.binaries"]
    runs = [subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) for _ in range(2)]

    assert [run.wait(PATIENCE) for run in runs] == [0, 0]
    assert sorted(record.read_text().split()) == sorted(["built"] * len(PACKAGES) + [*PACKAGES.values()])


def test_a_go_that_does_not_run_has_no_version(tmp_path: Path) -> None:
    assert version_of(tmp_path / "absent") == (0,)
    assert version_of(program(tmp_path / "go", "#!/bin/sh\nexit 1\n")) == (0,)
