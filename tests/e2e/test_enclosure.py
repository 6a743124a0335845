"""A node's changes to the machine end with it, even if it is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.cluster.waiting import wait_until
from tests.e2e.node.enclosure import CGROUP_PREFIX, CGROUPS, Enclosure, remove_stale_cgroups
from tests.e2e.programs import SYSTEM_PATH

RUN = """
import pathlib, sys, tempfile, time
from tests.cluster.children import remove_afterwards
from tests.e2e.node.enclosure import Enclosure
folder = pathlib.Path(tempfile.mkdtemp(prefix="wayside-e2e-"))
remove_afterwards(folder)
enclosure = Enclosure(folder)
enclosure.open()
child = enclosure.start("sleep", ["sleep", "1000000"], {})
print(folder, child.pid, flush=True)
time.sleep(10**6)
"""


def interfaces() -> str:
    return subprocess.run(["ip", "link"], capture_output=True, text=True, check=True).stdout


def cgroups(name: str) -> list[Path]:
    return [*CGROUPS.glob(f"{CGROUP_PREFIX}{name}"), *CGROUPS.glob(f"*/{CGROUP_PREFIX}{name}")]


def test_a_run_that_is_killed_leaves_nothing_but_cgroups_and_the_next_removes_them() -> None:
    run = subprocess.Popen([sys.executable, "-c", RUN], stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert run.stdout is not None
    folder, child = run.stdout.readline().split()
    assert f"we2e{run.pid}" in interfaces()
    assert cgroups(f"{run.pid}-*")

    os.kill(run.pid, signal.SIGKILL)
    run.wait()

    wait_until(lambda: f"we2e{run.pid}" in interfaces(), lambda there: not there, what="its interface is removed")
    wait_until(lambda: Path(f"/proc/{child}").exists(), lambda there: not there, what="its processes have ended")
    wait_until(lambda: Path(folder).exists(), lambda there: not there, what="its folder is removed")
    remove_stale_cgroups()
    assert cgroups(f"{run.pid}-*") == []


def test_what_is_done_inside_is_not_seen_outside(tmp_path: Path) -> None:
    before = (Path("/proc/sys/kernel/panic").read_text(), Path("/proc/sys/net/ipv4/ip_forward").read_text())
    tables = "iptables -t nat -N WAYSIDE-TEST && touch /etc/wayside-test /var/wayside-test /run/wayside-test"
    enclosure = Enclosure(tmp_path)
    enclosure.open()
    try:
        enclosure.run("sh", "-c", tables, path=SYSTEM_PATH)
        assert "WAYSIDE-TEST" in enclosure.run("iptables-save", path=SYSTEM_PATH)
        outside = subprocess.run(["/usr/sbin/iptables-save"], capture_output=True, text=True, check=True).stdout
        assert "WAYSIDE-TEST" not in outside
        assert not any(Path(f"/{name}/wayside-test").exists() for name in ("etc", "var", "run"))
    finally:
        enclosure.close()
    assert (Path("/proc/sys/kernel/panic").read_text(), Path("/proc/sys/net/ipv4/ip_forward").read_text()) == before
    assert enclosure.interface not in interfaces()
    assert cgroups(enclosure.cgroup.removeprefix(f"/{CGROUP_PREFIX}")) == []
