"""A detector in a cluster reports the state of its Lease, and its changes of tasks."""

from __future__ import annotations

import urllib.request

from prometheus_client.parser import text_string_to_metric_families

from tests.cluster.chain import CARS, FAR, HOLDER, NEAR, Chain, Vehicles
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until
from tests.ports import free_port


def test_the_lease_and_the_changes_of_tasks_are_metrics(chain: Chain, processes: Processes) -> None:
    port = free_port()
    options = ["--metrics-port", str(port), "--output", str(chain.folder)]
    processes.start("detector", "run", "--name", HOLDER, "--namespace", chain.namespace, *options)

    def metric(name: str) -> float:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
            families = text_string_to_metric_families(answer.read().decode())
        return sum(each.value for family in families for each in family.samples if each.name == name)

    with Vehicles(chain.endpoint) as vehicles:
        vehicles.place(CARS, NEAR)
        chain.wait_task(CARS)
        assert metric("wayside_detector_lease_held") == 1
        wait_until(
            lambda: metric("wayside_detector_task_changes_total"), lambda count: count == 1, what="one was created"
        )
        vehicles.place(CARS, FAR)
        wait_until(lambda: metric("wayside_detector_task_changes_total"), lambda count: count == 2, what="it has ended")
    assert metric("wayside_detector_lease_failures_total") == 0
