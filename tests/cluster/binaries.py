"""The programs of a control plane: found, or built from pinned source.

`python -m tests.cluster.binaries` builds what is missing and prints the folder.

Where they come from, in this order:

1. the folder that `KUBEBUILDER_ASSETS` names, for each program that it has (it usually has etcd, kube-apiserver and
   kubectl, but no kube-controller-manager);
2. the cache, `${XDG_CACHE_HOME:-~/.cache}/wayside/controlplane/<hash>/`, into which a missing program is built from
   the Go module in `controlplane/`. The hash covers all that decides what comes out: go.mod, go.sum, flags, platform.

Nothing prebuilt is ever downloaded, so the cluster tests run wherever Go modules do. A program appears in the cache by
an atomic rename: an interrupted build leaves nothing that looks finished. A lock keeps two builds of one cache apart.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from tests.cluster.toolchain import GoUnavailableError, find_go

MODULE = Path(__file__).parent / "controlplane"

PACKAGES: Mapping[str, str] = {  # the small ones first: an error of the setup shows after seconds
    "etcd": "go.etcd.io/etcd/server/v3",
    "kubectl": "k8s.io/kubernetes/cmd/kubectl",
    "kube-controller-manager": "k8s.io/kubernetes/cmd/kube-controller-manager",
    "kube-apiserver": "k8s.io/kubernetes/cmd/kube-apiserver",
}

# A plain `go build` knows no version and calls itself v0.0.0, which clients and CRD conversion then believe.
LDFLAGS = " ".join(
    (
        "-s -w",
        "-X k8s.io/component-base/version.gitVersion=v1.36.3",
        "-X k8s.io/component-base/version.gitMajor=1",
        "-X k8s.io/component-base/version.gitMinor=36",
    )
)
BUILD_FLAGS = ("-trimpath", "-buildvcs=false", "-ldflags", LDFLAGS)


class BinariesUnavailableError(Exception):
    """A program of the control plane is missing and cannot be built; the message says what to do."""


@dataclass(frozen=True)
class Binaries:
    """Where each program is."""

    etcd: Path
    kube_apiserver: Path
    kube_controller_manager: Path
    kubectl: Path


def ensure_binaries(console: Console | None = None) -> Binaries:
    """Find all programs and build those that are missing.

    Progress goes to `console` (default: stderr): a live line on a terminal, one line a program elsewhere.

    Raises:
        BinariesUnavailableError: a program cannot be had, with the remedy.
    """
    console = console or Console(stderr=True)
    found = {name: path for name in PACKAGES if (path := _find(name)) is not None}
    if missing := [name for name in PACKAGES if name not in found]:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / ".lock"):
            missing = [name for name in missing if _find(name) is None]  # somebody may have built it meanwhile
            for number, name in enumerate(missing, start=1):
                _build(name, folder, f"{number} of {len(missing)}", console)
        found |= {name: folder / name for name in PACKAGES if name not in found}
    return Binaries(**{name.replace("-", "_"): path for name, path in found.items()})


def cache_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of the programs built from the present go.mod, go.sum, flags and platform."""
    digest = hashlib.sha256()
    for part in (
        (MODULE / "go.mod").read_bytes(),
        (MODULE / "go.sum").read_bytes(),
        "\0".join(BUILD_FLAGS).encode(),
        f"{platform.system()}/{platform.machine()}".encode(),
    ):
        digest.update(len(part).to_bytes(8, "big") + part)
    base = environment.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "wayside" / "controlplane" / digest.hexdigest()[:16]


def _find(name: str) -> Path | None:
    if assets := os.environ.get("KUBEBUILDER_ASSETS"):
        if not Path(assets).is_dir():
            raise BinariesUnavailableError(
                f"KUBEBUILDER_ASSETS={assets} is not a folder: unset it to build the control plane from source, "
                "or set it to a folder with etcd and kube-apiserver"
            )
        if (given := Path(assets) / name).is_file():
            return given
        if name in ("etcd", "kube-apiserver"):  # a typing error in the variable must not start a build of minutes
            raise BinariesUnavailableError(
                f"KUBEBUILDER_ASSETS={assets} has no {name}: add it there, or unset the variable to build all"
            )
    built = cache_folder() / name
    return built if built.is_file() else None


def _build(name: str, folder: Path, which: str, console: Console) -> None:
    try:
        go = find_go(folder.parent / "go", console)
    except GoUnavailableError as error:
        raise BinariesUnavailableError(f"{name} has to be built, which needs Go: {error}") from error
    unfinished = folder / f".{name}.{os.getpid()}"
    command = [str(go), "build", *BUILD_FLAGS, "-o", str(unfinished), PACKAGES[name]]
    environment = os.environ | {"CGO_ENABLED": "0", "GOTOOLCHAIN": "local", "GOWORK": "off"}
    began = time.monotonic()
    try:
        with (
            _progress(f"building {name} ({which}, once; the largest takes minutes)", console),
            subprocess.Popen(
                command, cwd=MODULE, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            ) as build,
        ):
            output, _ = build.communicate()
        if build.returncode != 0:
            raise BinariesUnavailableError(
                f"building {name} failed (exit code {build.returncode}; needs the Go module proxy or a filled module "
                f"cache, about 2 GB of memory and 4 GB of disk):\n{output.strip()[-4000:]}"
            )
        unfinished.rename(folder / name)
    finally:
        unfinished.unlink(missing_ok=True)
    console.print(f"built {name} ({which}) in {time.monotonic() - began:.0f} s", highlight=False)


@contextmanager
def _progress(what: str, console: Console) -> Iterator[None]:
    """Show a spinner with the seconds so far on a terminal; a pipe gets one line at the start."""
    if not console.is_terminal:
        console.print(what, highlight=False)
        yield
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        progress.add_task(what, total=None)
        yield


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep others out of a folder."""
    with path.open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def main() -> int:
    """Build what is missing, print the folder of the built programs."""
    try:
        binaries = ensure_binaries()
    except BinariesUnavailableError as error:
        print(error, file=sys.stderr)
        return 1
    print(binaries.kube_controller_manager.parent)
    return 0


if __name__ == "__main__":
    sys.exit(main())
