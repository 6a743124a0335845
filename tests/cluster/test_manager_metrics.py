"""A running manager reports over HTTP: the objects, durations, and whether it is ready."""

from __future__ import annotations

import urllib.error
import urllib.request
from datetime import UTC, datetime, timedelta

import pytest
from prometheus_client.parser import text_string_to_metric_families

from application_manager.measures import PREFIX
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import start_manager, task, template
from tests.cluster.pods import mark_pods_ready
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from tests.ports import free_port


def get(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=PATIENCE) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def scraped(port: int) -> dict[tuple[str, ...], float]:
    return {
        (sample.name.removeprefix(PREFIX), *(sample.labels[key] for key in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(get(port, "/metrics")[1])
        for sample in family.samples
    }


def test_outcomes_of_tasks_are_counted_and_timed_from_their_events(
    processes: Processes, namespace: str, api: Api
) -> None:
    port = free_port()
    start_manager(processes, namespace, "--metrics-port", str(port))
    wait_until(lambda: get(port, "/readyz"), lambda found: found == (200, "ok\n"), what="it is ready")
    assert get(port, "/healthz") == (200, "ok\n")
    api.create(template())
    made = task("north", holder="town")
    began = (datetime.now(UTC) - timedelta(seconds=400)).strftime("%Y-%m-%dT%H:%M:%SZ")
    made["spec"]["event"] = {"id": "e", "rule": "r", "action": "a", "subject": "car1"} | dict.fromkeys(
        ("onsetTime", "startTime"), began
    )
    api.create(made)
    api.create(task("wrong", of="nowhere"))
    wait_until(lambda: mark_pods_ready(api), bool, what="the pod exists")
    found = wait_until(
        lambda: scraped(port),
        lambda found: (
            (found["tasks", "Ready"], found["tasks", "Refused"], found["instances", "Ready"]) == (1, 1, 1)
            and found["event_to_ready_seconds_count",] == 1
            and found["resync_time_seconds",] > 0
        ),
        what="the metrics count the objects",
    )
    assert found["event_to_applied_seconds_count",] == 1
    assert found["event_to_applied_seconds_bucket", "300.0"] == 0
    assert found["event_to_applied_seconds_sum",] > 399
    assert found["refusals_total", "TemplateNotFound"] == 1
    assert found["reconcile_seconds_count", "instance"] > 0
    assert found["api_request_seconds_count", "PATCH"] > 0
    assert found["leases", "renewed"] + found["leases", "overdue"] == 1
    assert found["api_reached",] == 1


@pytest.mark.own_control_plane
def test_while_the_api_server_is_away_the_manager_is_healthy_but_not_ready(
    processes: Processes, namespace: str, api: Api, control_plane: ControlPlane
) -> None:
    port = free_port()
    start_manager(processes, namespace, "--metrics-port", str(port))
    wait_until(lambda: get(port, "/readyz")[0], lambda code: code == 200, what="it is ready")
    control_plane.stop_api_server()
    away = (503, "the API server does not respond\n")
    wait_until(lambda: get(port, "/readyz"), away.__eq__, what="it is not ready and reports the reason")
    assert get(port, "/healthz")[0] == 200
    control_plane.recover()
    wait_until(lambda: get(port, "/readyz")[0], lambda code: code == 200, what="it is ready again")
    assert scraped(port)["api_errors_total", "none"] > 0


def test_a_port_in_use_is_reported_in_one_line_with_the_option(processes: Processes, namespace: str) -> None:
    port = free_port()
    start_manager(processes, namespace, "--metrics-port", str(port))
    second = processes.start("application-manager", "run", "--namespace", namespace, "--metrics-port", str(port))
    assert second.wait() == 2
    assert f"--metrics-port {port}: " in second.output()
