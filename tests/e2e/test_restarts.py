"""After failures of a node, its programs or the API server, everything matches the live demands."""

from __future__ import annotations

import time

import pytest

from tests.cluster.api import Api
from tests.cluster.chain import BETWEEN, BUSES, CARS, FAR, NEAR, TRAMS, VANS, untouched
from tests.e2e.node import Node
from tests.e2e.pairs_on_node import PairsOnNode, PublishedEvents, restarts_of
from wayside.times import parse_time

OUTAGE = 60.0
"""Seconds without the API server: longer than the detector's Lease of 15 s and the second that demands outlive it."""


@pytest.fixture
def town(node: Node, api: Api, image: str) -> PairsOnNode:
    """The programs are not started yet."""
    return PairsOnNode(node, api, image)


def test_episodes_continue_while_kubelet_and_containerd_restart(town: PairsOnNode) -> None:
    town.start()
    with town.vehicles() as vehicles:
        for pair in (CARS, VANS):
            vehicles.place(pair, NEAR)
        deployed, pod = town.wait_deployed(CARS), town.wait_running(CARS)
        town.wait_running(VANS)

        town.node.stop_program("kubelet")
        town.node.stop_program("containerd")
        vehicles.place(CARS, BETWEEN)
        vehicles.place(VANS, FAR)
        vehicles.place(BUSES, NEAR)
        town.wait_removed(VANS)
        town.wait_deployed(BUSES)
        assert len(town.pods(VANS)) == 1, "nobody could stop it"
        town.node.start_containerd()
        town.node.start_kubelet()
        town.node.wait_ready()

        town.wait_running(BUSES)
        town.wait_no_pods(VANS)
        same = town.wait_running(CARS)
        assert same["metadata"]["uid"] == pod["metadata"]["uid"]
        assert untouched(deployed, town.deployment(CARS))
        town.wait_programs()
        assert town.live() == {"+".join(CARS), "+".join(BUSES)}
        town.settled()


def test_after_a_restart_of_the_node_everything_runs_that_is_demanded_then(town: PairsOnNode) -> None:
    town.start()
    with town.vehicles() as vehicles:
        for pair in (CARS, VANS):
            vehicles.place(pair, NEAR)
        deployed, pod = town.wait_deployed(CARS), town.wait_running(CARS)
        task = town.wait_task(CARS)
        town.wait_running(VANS)

        town.node.power_off()
        vehicles.place(CARS, BETWEEN)
        vehicles.place(VANS, FAR)
        vehicles.place(BUSES, NEAR)
        town.node.power_on()

        town.wait_programs(restarts=1)
        town.wait_running(BUSES)
        town.wait_no_pods(VANS)
        again = town.wait_running(CARS, restarts=1)
        assert again["metadata"]["uid"] == pod["metadata"]["uid"]
        assert untouched(deployed, town.deployment(CARS))
        assert town.wait_task(CARS)["metadata"]["uid"] == task["metadata"]["uid"]
        assert town.live() == {"+".join(CARS), "+".join(BUSES)}
        town.settled()


def test_without_the_api_server_applications_continue_and_what_was_seen_is_reported_afterwards(
    town: PairsOnNode, api: Api
) -> None:
    town.start(after="1s")
    with town.vehicles() as vehicles, PublishedEvents(town.endpoint) as heard:
        for pair in (CARS, VANS):
            vehicles.place(pair, NEAR)
        deployed, pod = town.wait_deployed(CARS), town.wait_running(CARS)
        task = town.wait_task(CARS)
        town.wait_running(VANS)

        with town.node.plane.outage():
            began = time.monotonic()
            vehicles.place(CARS, BETWEEN)
            vehicles.place(VANS, FAR)
            heard.wait(VANS, "started", "Until")
            for pair in (BUSES, TRAMS):
                vehicles.place(pair, NEAR)
                heard.wait(pair, "started")
            vehicles.place(TRAMS, FAR)
            heard.wait(TRAMS, "started", "Until")
            time.sleep(max(began + OUTAGE - time.monotonic(), 0.0))  # the outage must outlast the Lease
            back = time.time_ns()

        town.wait_running(BUSES)
        town.wait_no_pods(VANS)
        same = town.wait_running(CARS)
        assert same["metadata"]["uid"] == pod["metadata"]["uid"]
        assert same["status"]["containerStatuses"] == pod["status"]["containerStatuses"]
        assert untouched(deployed, town.deployment(CARS))
        assert town.wait_task(CARS)["metadata"]["uid"] == task["metadata"]["uid"]
        assert town.live() == {"+".join(CARS), "+".join(BUSES)}
        town.settled()
        assert parse_time(town.wait_task(BUSES)["spec"]["event"]["startTime"]) < back
        (ended,) = [task for task in api.list("ApplicationTask") if task["spec"]["event"]["subject"] == "+".join(VANS)]
        assert parse_time(ended["spec"]["endTime"]) < back
        assert not town.pods(TRAMS), "an episode that could not be reported in time demands nothing afterwards"
        assert heard.kinds(CARS) == ["started"]
        assert [restarts_of(program) for program in town.programs()] == [0, 0]
