"""A manager that hangs is ended by its watchdog, and its standby takes over."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from application_manager.running.watchdog import STALLED
from tests import programs
from tests.cluster.api import Api
from tests.cluster.expected_objects import start_manager, task, template, wait_settled
from tests.cluster.processes import Processes
from tests.ports import free_port

HANGING = """
import signal, time

def hang(*_):
    time.sleep(3600)

signal.signal(signal.SIGUSR1, hang)
"""


def test_a_manager_whose_event_loop_hangs_ends_and_another_takes_over(
    api: Api, processes: Processes, namespace: str, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(HANGING)
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    command = (programs.script("application-manager"), "run", "--namespace", namespace, "--stalled-after", "5s")
    hanging = processes.start(*command, "--metrics-port", str(free_port()), environment={"PYTHONPATH": path})
    hanging.wait_for_output("active: holds the Lease")
    standby = start_manager(processes, namespace)
    api.create(template())
    api.create(task("north"))
    wait_settled(api)
    os.kill(hanging.pid, signal.SIGUSR1)
    assert hanging.wait() == STALLED
    logged = hanging.output()
    assert "CRITICAL watchdog: the event loop has not run for" in logged
    assert "ending this manager so that it is restarted" in logged
    assert "in hang" in logged, "and where it hangs"
    standby.wait_for_output("active: holds the Lease")
    api.create(task("south"))
    wait_settled(api)


def test_a_manager_that_was_suspended_and_continues_is_not_ended(
    api: Api, processes: Processes, namespace: str
) -> None:
    manager = start_manager(processes, namespace, "--stalled-after", "5s")
    manager.wait_for_output("active: holds the Lease")
    other = start_manager(processes, namespace)
    os.kill(manager.pid, signal.SIGSTOP)
    other.wait_for_output("active: holds the Lease")  # which takes longer than the watchdog's limit
    os.kill(manager.pid, signal.SIGCONT)
    manager.wait_for_output("standby: ")
    api.create(template())
    api.create(task("north"))
    wait_settled(api)
    other.terminate()
    api.create(task("south"))
    wait_settled(api)
    assert manager.alive
