"""Processes of tests: what they write is kept, and none is left behind."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.processes import Process, Processes
from tests.cluster.waiting import wait_until

WAIT_FOR_SIGTERM = """
import signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # from here on it waits, whenever it comes
print("started with", sys.argv[1:], flush=True)
signal.sigwait({signal.SIGTERM})
print("ended in peace", flush=True)
"""
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
    """Not that of the control plane, which these tests do not need."""
    started = Processes(tmp_path, {"FOR_ALL": "everybody"})
    yield started
    started.kill_all()


def exists(pid: int) -> bool:
    """Whether a process lives; a zombie that nobody waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def start(processes: Processes, program: str, *arguments: str, name: str = "program") -> Process:
    return processes.start(sys.executable, "-c", program, *arguments, name=name)


def test_sigterm_lets_a_program_end_in_peace(processes: Processes) -> None:
    program = start(processes, WAIT_FOR_SIGTERM, "x")
    program.wait_for_output(r"started with \['x'\]")
    assert program.terminate() == 0
    assert "ended in peace" in program.output()


def test_a_program_that_does_not_heed_sigterm_is_a_failure_and_killed(processes: Processes) -> None:
    program = start(processes, IGNORE_SIGTERM)
    program.wait_for_output("started")
    with pytest.raises(TimeoutError, match=r"program .* still runs"):
        program.terminate(patience=0.2)
    assert not program.alive


def test_a_killed_program_starts_again_with_the_same_command_line_and_log(processes: Processes) -> None:
    program = start(processes, WAIT_FOR_SIGTERM, "x")
    program.wait_for_output(r"started with \['x'\]")  # all of it: unbuffered, `print` writes each part by itself
    first = program.pid
    program.kill9()
    assert program.returncode == -9

    program.start()
    program.wait_for_output(r"started with \['x'\]")
    assert program.pid != first
    assert program.log.read_text().count("started with ['x']") == 2
    assert program.output().count("started with ['x']") == 1


def test_starting_what_still_runs_is_refused(processes: Processes) -> None:
    program = start(processes, WAIT_FOR_SIGTERM)
    with pytest.raises(AssertionError, match="still runs"):
        program.start()


def test_a_program_that_ends_while_its_output_is_awaited_is_told_at_once_with_its_log(processes: Processes) -> None:
    program = start(processes, "raise SystemExit('no such template')")
    with pytest.raises(ChildProcessError, match=r"(?s)ended without writing 'ready'.*no such template"):
        program.wait_for_output("ready", timeout=60)


def test_programs_get_the_environment_of_all_and_their_own(processes: Processes) -> None:
    show = "import os; print(os.environ['FOR_ALL'], os.environ['OWN'], 'PATH' in os.environ)"
    program = processes.start(sys.executable, "-c", show, environment={"OWN": "mine"})
    program.wait_for_output("everybody mine True")


def test_programs_of_one_name_are_numbered(processes: Processes) -> None:
    names = [processes.start("true").name for _ in range(3)]
    assert names == ["true", "true-2", "true-3"]


def test_programs_beside_the_interpreter_need_no_path(processes: Processes) -> None:
    program = processes.start("pytest", "--version", environment={"PATH": "/nowhere"})
    program.wait_for_output("pytest")
    assert program.wait() == 0


def test_what_a_program_started_is_killed_with_it(processes: Processes) -> None:
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
