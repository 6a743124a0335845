"""Processes of tests: their output is kept, and all are stopped."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.processes import Process, Processes
from tests.cluster.waiting import wait_until

IGNORE_SIGTERM = """
import signal
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("started", flush=True)
while True:
    signal.pause()
"""
START_A_CHILD = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"])
print("child", child.pid, flush=True)
child.wait()
"""


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    """Replaces the control plane's fixture, which these tests do not need."""
    started = Processes(tmp_path, {})
    yield started
    started.kill_all()


def exists(pid: int) -> bool:
    """Whether a process is alive; a zombie is not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def start(processes: Processes, program: str) -> Process:
    return processes.start(sys.executable, "-c", program, name="program")


def test_a_program_that_ignores_sigterm_is_killed_and_reported_as_a_failure(processes: Processes) -> None:
    program = start(processes, IGNORE_SIGTERM)
    program.wait_for_output("started")
    with pytest.raises(TimeoutError, match=r"program .* still runs"):
        program.terminate(patience=0.2)
    assert not program.alive


def test_starting_a_running_program_is_refused(processes: Processes) -> None:
    program = start(processes, IGNORE_SIGTERM)
    with pytest.raises(AssertionError, match="still runs"):
        program.start()


def test_a_program_that_ends_while_its_output_is_awaited_is_reported_at_once_with_its_log(processes: Processes) -> None:
    program = start(processes, "raise SystemExit('no such template')")
    with pytest.raises(ChildProcessError, match=r"(?s)ended without writing 'ready'.*no such template"):
        program.wait_for_output("ready")


def test_child_processes_are_killed_with_their_program(processes: Processes) -> None:
    program = start(processes, START_A_CHILD)
    child = int(program.wait_for_output(r"child (\d+)")[1])
    program.kill9()
    wait_until(lambda: exists(child), lambda lives: not lives, what="the child's end")


def test_a_killed_test_run_leaves_nothing_behind(tmp_path: Path) -> None:
    data = tmp_path / "data"
    (data / "inner").mkdir(parents=True)
    run = f"""
import os, signal, sys
from pathlib import Path
from tests.cluster.children import Child, remove_afterwards
remove_afterwards(Path({str(data)!r}))
ended = Child("ended", ["true"], Path({str(tmp_path)!r}) / "ended.log")
ended.wait(60)
left = Child("left", [sys.executable, "-c", "import signal; signal.pause()"], Path({str(tmp_path)!r}) / "left.log")
print(left.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", run], stdout=subprocess.PIPE, text=True, check=False)
    assert done.returncode == -9
    left = int(done.stdout)
    wait_until(lambda: exists(left), lambda lives: not lives, what=f"process {left} is killed")
    wait_until(data.exists, lambda there: not there, what="its data is removed")
