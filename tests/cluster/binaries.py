"""The programs of a control plane: found, or built from pinned source.

`python -m tests.cluster.binaries` builds what is missing and prints the folder.

Where they come from, in this order:

1. the folder that `KUBEBUILDER_ASSETS` names, for each program that it has (it usually has etcd, kube-apiserver and
   kubectl, but no kube-controller-manager);
2. the cache, `${XDG_CACHE_HOME:-~/.cache}/wayside/controlplane/<hash>/`, into which a missing program is built from
   the Go module in `controlplane/`. The hash covers all inputs of the build: go.mod, go.sum, flags, platform.

With `WAYSIDE_TEST_KUBERNETES=oldest` these are of the oldest Kubernetes that Wayside supports (`make compat`).
Nothing prebuilt is ever downloaded, so the cluster tests run wherever Go modules do.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from tests.gobuild import KUBERNETES, OLDEST_KUBERNETES, BuildError, GoModule

PACKAGES: Mapping[str, str] = {  # the small ones first: a setup error appears after seconds
    "etcd": "go.etcd.io/etcd/server/v3",
    "kubectl": "k8s.io/kubernetes/cmd/kubectl",
    "kube-scheduler": "k8s.io/kubernetes/cmd/kube-scheduler",
    "kube-controller-manager": "k8s.io/kubernetes/cmd/kube-controller-manager",
    "kube-apiserver": "k8s.io/kubernetes/cmd/kube-apiserver",
}

_FOLDER = Path(__file__).parent / "controlplane"
MODULE = GoModule("controlplane", _FOLDER, PACKAGES, KUBERNETES)
OLDEST = GoModule(
    "controlplane",
    _FOLDER / "oldest",
    {name: package for name, package in PACKAGES.items() if name not in ("etcd", "kubectl")},
    OLDEST_KUBERNETES,
)
"""The programs of the oldest Kubernetes that Wayside supports; etcd and kubectl are those of `MODULE`."""

VERSION = "WAYSIDE_TEST_KUBERNETES"
"""The environment variable that selects the version: `oldest`, otherwise the newest."""


class BinariesUnavailableError(Exception):
    """A program of the control plane is missing and cannot be built; the message gives the remedy."""


@dataclass(frozen=True)
class Binaries:
    """The path of each program."""

    etcd: Path
    kube_apiserver: Path
    kube_controller_manager: Path
    kube_scheduler: Path
    kubectl: Path


def ensure_binaries(console: Console | None = None) -> Binaries:
    """Find all programs and build those that are missing.

    Progress goes to `console` (default: stderr): a live line on a terminal, otherwise one line for each program.

    Raises:
        BinariesUnavailableError: a program cannot be built; with the remedy.
    """
    console = console or Console(stderr=True)
    found = {name: path for name in PACKAGES if (path := _find(name)) is not None}
    for module in (MODULE, OLDEST):
        if missing := tuple(name for name in PACKAGES if name not in found and _module(name) is module):
            try:
                folder = module.ensure(console, missing)
            except BuildError as error:
                raise BinariesUnavailableError(str(error)) from error
            found |= {name: folder / name for name in missing}
    return Binaries(**{name.replace("-", "_"): path for name, path in found.items()})


def cache_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of the programs built from the present go.mod, go.sum, flags and platform."""
    return MODULE.folder(environment)


def _find(name: str) -> Path | None:
    if assets := os.environ.get("KUBEBUILDER_ASSETS"):
        if not Path(assets).is_dir():
            raise BinariesUnavailableError(
                f"KUBEBUILDER_ASSETS={assets} is not a folder: unset it to build the control plane from source, "
                "or set it to a folder with etcd and kube-apiserver"
            )
        if (given := Path(assets) / name).is_file():
            return given
        if name in ("etcd", "kube-apiserver"):  # a typo in the variable must not start a build of minutes
            raise BinariesUnavailableError(
                f"KUBEBUILDER_ASSETS={assets} has no {name}: add it there, or unset the variable to build all"
            )
    built = _module(name).folder() / name
    return built if built.is_file() else None


def _module(name: str) -> GoModule:
    """The Go module of a program."""
    return OLDEST if os.environ.get(VERSION) == "oldest" and name in OLDEST.packages else MODULE


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
