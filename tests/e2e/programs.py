"""The programs of a node: Debian's where it packages them, the others built from pinned source.

`python -m tests.e2e.programs` installs and builds the missing programs, except those of the control plane: they
have a separate cache (`tests.cluster.binaries`), which the tests without a node fill.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from tests.gobuild import KUBERNETES, BuildError, GoModule, apt_lock

MODULES = Path(__file__).parent / "modules"
CONTAINERD = "github.com/containerd/containerd/v2/cmd"
PLUGINS = "github.com/containernetworking/plugins/plugins"

CONTAINERS = GoModule(
    "containers",
    MODULES / "containers",
    {
        "bridge": f"{PLUGINS}/main/bridge",
        "loopback": f"{PLUGINS}/main/loopback",
        "host-local": f"{PLUGINS}/ipam/host-local",
        "containerd-shim-runc-v2": f"{CONTAINERD}/containerd-shim-runc-v2",
        "ctr": f"{CONTAINERD}/ctr",
        "containerd": f"{CONTAINERD}/containerd",
    },
)
NODE = GoModule(
    "node",
    MODULES / "kubernetes",
    {name: f"k8s.io/kubernetes/cmd/{name}" for name in ("kube-proxy", "kubelet")},
    KUBERNETES,
)
COREDNS = GoModule("coredns", MODULES / "coredns", {"coredns": "."})
PAUSE = GoModule("pause", MODULES / "pause", {"pause": "."})

PACKAGES = {
    "runc": "runc",
    "iptables": "iptables",
    "conntrack": "conntrack",
    "debootstrap": "debootstrap",
    "ip": "iproute2",
}
"""The Debian package of each program."""
PATIENTLY = ("-o", "Acquire::Retries=5", "-o", "DPkg::Lock::Timeout=600")
"""apt-get retries when a mirror fails, and waits while another process holds its lock."""
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class ProgramsUnavailableError(Exception):
    """A program of the node is missing and unavailable; the message gives the remedy."""


@dataclass(frozen=True)
class Programs:
    """The folders of the programs that are built here; those from Debian are on the system's PATH."""

    containers: Path
    node: Path
    coredns: Path
    pause: Path

    @property
    def path(self) -> str:
        """A PATH with all programs of the node."""
        return f"{self.containers}:{self.node}:{SYSTEM_PATH}"


def ensure_programs(console: Console | None = None) -> Programs:
    """Find all programs; install and build the missing ones.

    Raises:
        ProgramsUnavailableError: a program is missing and unavailable; with the remedy.
    """
    console = console or Console(stderr=True)
    install(console)
    try:
        folders = [module.ensure(console) for module in (CONTAINERS, NODE, COREDNS, PAUSE)]
    except BuildError as error:
        raise ProgramsUnavailableError(str(error)) from error
    return Programs(*folders[:2], folders[2] / "coredns", folders[3] / "pause")


def install(console: Console) -> None:
    """Install the missing Debian packages. Raises ProgramsUnavailableError."""
    with apt_lock():
        missing = sorted(package for name, package in PACKAGES.items() if shutil.which(name, path=SYSTEM_PATH) is None)
        if missing:
            _install(missing, console)


def _install(missing: Sequence[str], console: Console) -> None:
    reported = (
        f"the node needs {', '.join(missing)}: apt-get install {' '.join(missing)} as root, or your system's own way"
    )
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        raise ProgramsUnavailableError(reported)
    console.print(f"installing {', '.join(missing)} with apt-get", highlight=False)
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update"], ["install", "--yes", "--no-install-recommends", *missing]):
        done = subprocess.run(
            ["apt-get", "--quiet", *PATIENTLY, *command], env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            output = (done.stdout + done.stderr)[-3000:]
            raise ProgramsUnavailableError(f"{reported}\n`apt-get {' '.join(command)}` failed:\n{output}")


def main() -> int:
    """Provide the programs that a node runs beside its control plane; none where no node can run."""
    from tests.e2e.privileges import why_no_node  # circular: its imports import this module

    if (reason := why_no_node()) is not None:
        print(f"nothing is built for the tests on a real node, which are skipped: {reason}")
        return 0
    try:
        print(ensure_programs().containers.parent.parent)
    except ProgramsUnavailableError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
