"""The first process inside an enclosure: it creates the mounts and addresses, then reaps orphaned processes.

Called with the state folder, the node's address and the machine's. It runs as process 1 of its namespace; when it ends,
all processes inside end too.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

LAYERED = ("etc", "opt", "var")
"""Folders of the machine that programs of a node always write to; their writes are redirected."""

KERNEL = {
    "vm/overcommit_memory": "1",
    "vm/panic_on_oom": "0",
    "kernel/panic": "10",
    "kernel/panic_on_oops": "1",
    "kernel/keys/root_maxkeys": "1000000",
    "kernel/keys/root_maxbytes": "25000000",
}
"""The sysctls that kubelet requires, for the whole machine. Files mounted over them report the required values."""


def enclose(folder: Path, inside: str, outside: str) -> None:
    """Create the mounts and addresses."""
    _run("mount", "--make-rshared", "/")
    _run("mount", "-t", "proc", "proc", "/proc")
    _run("mount", "-t", "tmpfs", "tmpfs", "/run")
    for name in LAYERED:
        upper, work = folder / "layers" / name / "upper", folder / "layers" / name / "work"
        upper.mkdir(parents=True)
        work.mkdir()
        _run("mount", "-t", "overlay", "-o", f"lowerdir=/{name},upperdir={upper},workdir={work}", "overlay", f"/{name}")
    for name, value in KERNEL.items():
        stand_in = folder / "kernel" / name
        stand_in.parent.mkdir(parents=True, exist_ok=True)
        stand_in.write_text(f"{value}\n")
        _run("mount", "--bind", str(stand_in), f"/proc/sys/{name}")
    _run("ip", "link", "set", "lo", "up")
    deadline = time.monotonic() + 60
    while not Path("/proc/sys/net/ipv4/conf/uplink").exists():
        if time.monotonic() > deadline:
            raise SystemExit("the interface uplink does not appear")
        time.sleep(0.02)
    _run("ip", "address", "add", f"{inside}/30", "dev", "uplink")
    _run("ip", "link", "set", "uplink", "up")
    _run("ip", "route", "add", "default", "via", outside)
    Path("/proc/sys/net/ipv4/ip_forward").write_text("1")
    bridged = Path("/proc/sys/net/bridge/bridge-nf-call-iptables")
    if bridged.exists():  # otherwise the address of a Service that leads back to its own bridge is not translated
        bridged.write_text("1")
    (folder / "enclosed").touch()


def _run(*command: str) -> None:
    subprocess.run(command, check=True)


def _collect() -> None:
    while True:
        try:
            os.waitpid(-1, 0)
        except ChildProcessError:
            time.sleep(0.2)


if __name__ == "__main__":
    enclose(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
    _collect()
