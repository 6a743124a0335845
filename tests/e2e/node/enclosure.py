"""The Linux namespaces of a node, with separate mounts, network and processes.

Everything that a node does to a machine (network interfaces, iptables rules, mounts, daemons that outlive their parent)
happens inside, so it neither affects other programs of the machine nor stays: the kernel removes all when the first
process inside ends, also if the test run was killed (`tests.cluster.reaper`). Only cgroups are outside. They have
the process id of the test run in their name, and the next run removes those of ended runs.

One pair of interfaces connects outside and inside, on addresses that RFC 2544 reserves for benchmarks.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tests.cluster.children import Child
from tests.cluster.waiting import wait_until
from tests.patience import NODE_PATIENCE

CGROUPS = Path("/sys/fs/cgroup")
CGROUP_PREFIX = "wayside-e2e-"
INIT = Path(__file__).with_name("init.py")
_numbers = itertools.count()
ATTEMPTS = 100  # at 0.05 s: a cgroup is busy until the kernel has cleaned up its last process


class Enclosure:
    """One set of namespaces.

    Attributes:
        folder: the data of the programs inside; it exists, and the caller removes it.
        outside: the machine's address, as seen from inside.
        inside: the node's address.
        cgroup: the parent of the containers' cgroups, `/wayside-e2e-<pid of the test run>-<number>`.
        interface: the machine's end of the pair.
    """

    def __init__(self, folder: Path):
        """Prepare; nothing is created yet."""
        self.folder = folder
        number = next(_numbers)
        self.cgroup = f"/{CGROUP_PREFIX}{os.getpid()}-{number}"
        self.interface = f"we2e{os.getpid()}.{number}"
        network = _free_network()
        self.outside, self.inside = f"{network}.1", f"{network}.2"
        self._anchor: Child | None = None
        self._target = 0

    @property
    def enter(self) -> tuple[str, ...]:
        """The prefix of a command line that runs it inside."""
        assert self._target, "the enclosure is not open"
        return ("nsenter", f"--target={self._target}", "--mount", "--net", "--pid", "--")

    def open(self) -> None:
        """Create the namespaces and the link to the machine. Raises TimeoutError with the log of the first process."""
        remove_stale_cgroups()
        for root in cgroup_roots():
            (root / self.cgroup[1:]).mkdir(exist_ok=True)
            _inherit_cpuset(root / self.cgroup[1:])
        namespaces = ["--mount", "--net", "--pid", "--propagation=private", "--fork", "--kill-child"]
        first = [sys.executable, str(INIT), str(self.folder), self.inside, self.outside]
        log = self.folder / "init.log"
        anchor = self._anchor = Child("init", ["unshare", *namespaces, *first], log)
        children = Path(f"/proc/{anchor.pid}/task/{anchor.pid}/children")
        found = wait_until(
            lambda: children.read_text().split() if anchor.alive else [],
            bool,
            what="the namespaces exist",
            diagnose=anchor.tail,
        )
        self._target = int(found[0])
        self._join()

    def run(self, *command: str, path: str, timeout: float = NODE_PATIENCE) -> str:
        """Run a command inside to its end and return its stdout; RuntimeError with its stderr if it fails."""
        done = subprocess.run(
            [*self.enter, *command],
            env=os.environ | {"PATH": path},
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout

    def start(self, name: str, command: Sequence[str], environment: Mapping[str, str]) -> Child:
        """Start a program inside; its log is `<folder>/<name>.log`."""
        return Child(name, [*self.enter, *command], self.folder / f"{name}.log", {**os.environ, **environment})

    def kill(self, name: str) -> None:
        """Kill the programs inside with this name prefix and all in the node's cgroups; return when all have ended."""

        def left() -> list[int]:
            found = [*self._named(name), *_pids(self.cgroup[1:])]
            for pid in found:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            return found

        wait_until(left, lambda found: not found, what=f"no process of {name} or the node's cgroups runs")

    def _named(self, name: str) -> Iterator[int]:
        own = _namespace(self._target)
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if _namespace(int(path.name)) == own and (path / "comm").read_text().startswith(name):
                    yield int(path.name)

    def close(self) -> None:
        """End everything inside, and remove the cgroups."""
        if self._anchor is not None:
            # The kernel would also remove the interface, but some time after the last process inside ends.
            subprocess.run(["ip", "link", "delete", self.interface], capture_output=True, check=False)
            self._anchor.kill9()
        self._anchor, self._target = None, 0
        _remove_cgroups(self.cgroup[1:])

    def _join(self) -> None:
        """Create the pair of interfaces; the first process inside waits for the inner one."""
        name = self.interface
        _ip("link", "add", name, "type", "veth", "peer", "name", "uplink", "netns", str(self._target))
        _ip("address", "add", f"{self.outside}/30", "dev", name)
        _ip("link", "set", name, "up")
        anchor = self._anchor
        assert anchor is not None

        def ready() -> bool:
            if not anchor.alive:
                raise RuntimeError(f"the first process of the enclosure ended\n{anchor.tail()}")
            return (self.folder / "enclosed").exists()

        wait_until(ready, bool, what="the enclosure has its mounts and addresses", diagnose=anchor.tail)


def remove_stale_cgroups() -> None:
    """Remove the cgroups of ended test runs."""
    for name in {path.name for root in cgroup_roots() for path in root.glob(f"{CGROUP_PREFIX}*")}:
        if not Path(f"/proc/{name.removeprefix(CGROUP_PREFIX).partition('-')[0]}").exists():
            _remove_cgroups(name)


def _namespace(pid: int) -> str:
    return os.readlink(f"/proc/{pid}/ns/pid")


def _pids(cgroup: str) -> set[int]:
    files = [file for root in cgroup_roots() for file in (root / cgroup).rglob("cgroup.procs")]
    found: set[int] = set()
    for file in files:
        with contextlib.suppress(OSError):  # removed meanwhile
            found.update(map(int, file.read_text().split()))
    return found


def _remove_cgroups(name: str) -> None:
    for root in cgroup_roots():
        for path, _, _ in os.walk(root / name, topdown=False):
            for attempt in range(ATTEMPTS):
                try:
                    os.rmdir(path)
                except FileNotFoundError:
                    break
                except OSError:
                    if attempt == ATTEMPTS - 1:
                        raise
                    time.sleep(0.05)
                else:
                    break


def cgroup_roots() -> list[Path]:
    """The mounted hierarchies: one with version 2, several with version 1."""
    mounts = (line.split() for line in Path("/proc/mounts").read_text().splitlines())
    found = sorted({Path(where) for _, where, kind, *_ in mounts if kind in ("cgroup", "cgroup2")})
    return [root for root in found if root.is_relative_to(CGROUPS)]


def _inherit_cpuset(cgroup: Path) -> None:
    """Version 1 creates a cgroup without processors, in which no process can run."""
    for name in ("cpuset.cpus", "cpuset.mems"):
        if (cgroup / name).exists() and (cgroup.parent / "cgroup.clone_children").exists():
            (cgroup / name).write_text((cgroup.parent / name).read_text())


def _free_network() -> str:
    """Return the first three numbers of a /24 network without a route."""
    routes = subprocess.run(["ip", "-4", "route"], capture_output=True, text=True, check=True).stdout
    free = [f"198.18.{third}" for third in range(256) if f"198.18.{third}." not in routes]
    return random.SystemRandom().choice(free)


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"`ip {' '.join(arguments)}` failed: {done.stderr.strip()}")
