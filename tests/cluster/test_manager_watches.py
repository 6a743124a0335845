"""Silent watches are restarted or end the manager; none is lost unnoticed."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

from application_manager.core.claims.claims import instance_name
from application_manager.running.watchdog import STALLED
from tests import programs
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import start_manager, task, template, wait_settled
from tests.cluster.faulty_proxy import faulty_proxy
from tests.cluster.processes import Processes
from tests.cluster.test_manager_metrics import scraped
from tests.ports import free_port

SOUTH = instance_name("app", "south")
SELDOM = ("--resync", "300s", "--watch-timeout", "3s")  # only a watch delivers changes in time

CANCELLING = """
import asyncio, signal

def cancel(*_):
    for task in asyncio.all_tasks():
        if task.get_name().startswith("watcher for applicationtasks"):
            task.cancel()

signal.signal(signal.SIGUSR1, cancel)
"""
"""A stall cancels the task that reads a watch of kopf, see docs/decisions/0026."""


def test_a_watch_on_a_silent_connection_is_restarted(
    api: Api, control_plane: ControlPlane, processes: Processes, namespace: str
) -> None:
    with faulty_proxy(control_plane.kubeconfig) as (proxy, kubeconfig):
        port = free_port()
        manager = start_manager(processes, namespace, *SELDOM, "--metrics-port", str(port), kubeconfig=kubeconfig)
        api.create(template())
        api.create(task("north"))
        wait_settled(api)
        assert ("watch_age_seconds", "applicationtasks") in scraped(port)
        proxy.hushed = frozenset(
            index
            for index, each in enumerate(proxy.seen)
            if "watch=true" in each.path and "/applicationtasks?" in each.path
        )
        api.create(task("south"))
        api.wait_for("Deployment", SOUTH, lambda _: True, what="a new watch reports the task")
        manager.wait_for_output("the watch of applicationtasks in .* had no event or bookmark")
        wait_settled(api)
        assert manager.alive


def test_a_watch_that_cannot_be_restarted_ends_the_manager(
    api: Api, processes: Processes, namespace: str, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(CANCELLING)
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    command = (programs.script("application-manager"), "run", "--namespace", namespace, *SELDOM)
    manager = processes.start(*command, environment={"PYTHONPATH": path})
    manager.wait_for_output("watching")
    api.create(template())
    api.create(task("north"))
    wait_settled(api)
    os.kill(manager.pid, signal.SIGUSR1)
    assert manager.wait() == STALLED
    assert re.search(r"CRITICAL watchdog: the watch of applicationtasks has had neither events nor", manager.output())
