"""The Zenoh router restarts while vehicles publish: all sessions reconnect, and lost samples are counted."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from zenoh import ext

from detector.streams.zenoh import open_session
from tests.cluster.api import Api
from tests.cluster.chain import BETWEEN, CARS, NEAR, PERIOD, VANS, untouched
from tests.cluster.waiting import wait_until
from tests.e2e.node import Node
from tests.e2e.pairs_on_node import PairsOnNode, restarts_of
from tests.e2e.wayside_in_cluster import ZENOH_PORT
from tests.e2e.workloads import deployment, running_pods, service, wait_available
from tests.patience import NODE_PATIENCE
from tests.process.test_rmw_zenoh import Node as RosNode
from wayside.api.zenoh import Zenoh, ZenohMode

ROUTER = f"""
import os, signal, threading, zenoh
signal.signal(signal.SIGTERM, lambda *_: os._exit(1))
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("listen/endpoints", '["tcp/0.0.0.0:{ZENOH_PORT}"]')
session = zenoh.open(config)
while True:
    signal.pause()
"""
CRASH = "import os, signal; os.kill(1, signal.SIGTERM)"
ROS_STREAM = {
    "name": "speed",
    "key": "vehicles/${client:*}/speed",
    "layout": "RmwZenoh",
    "encoding": "cdr",
    "type": "std_msgs/msg/Float64",
}
ADVANCED_STREAM = {"name": "heading", "key": "vehicles/${client:*}/heading", "encoding": "json"}
POSE_STREAM = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json", "staleAfter": "2s"}
FLOAT = b"\x00\x01\x00\x00" + bytes(8)
LOST = 20
"""The minimum number of samples of each stream to publish without a router."""


class NumberingVehicle:
    """A vehicle that publishes ten numbered samples a second on each stream.

    Attributes:
        sent: the number of samples published on each stream.
    """

    def __init__(self, endpoint: str) -> None:
        self.sent = 0
        self._ended = threading.Event()
        self._session = open_session(Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint]))
        self._ros = RosNode(self._session, "vehicles/car1/speed", type_name="std_msgs/msg/Float64")
        self._advanced = ext.declare_advanced_publisher(
            self._session, "vehicles/car1/heading", sample_miss_detection=ext.MissDetectionConfig()
        )
        self._seen = [
            self._session.declare_publisher(key) for key in ("0/vehicles/car1/speed/type/hash", "vehicles/car1/heading")
        ]
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Publish once the detector has subscribed to both streams, so that the first samples arrive."""
        wait_until(
            lambda: [each.matching_status.matching for each in self._seen],
            all,
            timeout=NODE_PATIENCE,
            what="the detector is subscribed",
        )
        self._thread.start()

    def wait_sent(self, more: int) -> None:
        """Wait until `more` further samples of each stream are published."""
        goal = self.sent + more
        wait_until(lambda: self.sent, lambda sent: sent >= goal, timeout=NODE_PATIENCE, what=f"{goal} were sent")

    def stop(self) -> int:
        """Stop publishing; return the number of samples published on each stream."""
        self._ended.set()
        self._thread.join()
        return self.sent

    def close(self) -> None:
        """End the session."""
        self._ended.set()
        self._session.close()  # type: ignore[no-untyped-call]

    def _run(self) -> None:
        while not self._ended.wait(PERIOD):
            self._ros.publish(FLOAT)
            self._advanced.put(b"{}")
            self.sent += 1


@contextmanager
def numbered(endpoint: str) -> Iterator[NumberingVehicle]:
    vehicle = NumberingVehicle(endpoint)
    try:
        yield vehicle
    finally:
        vehicle.close()


def metric_sum(metrics: Mapping[str, float], name: str, **labels: str) -> float:
    """The sum of the metric's series that have these labels."""
    wanted = [f'{label}="{value}"' for label, value in labels.items()]
    return sum(
        value
        for key, value in metrics.items()
        if key.startswith(f"wayside_detector_{name}{{") and all(each in key for each in wanted)
    )


def arrived(metrics: Mapping[str, float], stream: str) -> int:
    return int(metric_sum(metrics, "stream_samples_total", stream=stream))


def missed(metrics: Mapping[str, float], stream: str) -> int:
    return int(metric_sum(metrics, "losses_total", stream=stream, cause="missed"))


@pytest.fixture
def router(api: Api, image: str) -> str:
    """Run a router; return the name of its Deployment and Service."""
    pod: dict[str, Any] = {"port": ZENOH_PORT}
    api.apply(deployment("router", image, ["python3", "-c", ROUTER], **pod))
    api.apply(service("router", ZENOH_PORT, type="NodePort"))
    wait_available(api, "router")
    return "router"


def test_detector_and_vehicles_find_a_restarted_router_and_losses_are_counted(
    node: Node, api: Api, image: str, router: str
) -> None:
    town = PairsOnNode(node, api, image)
    town.start(
        zenoh={"mode": "client", "connect": [f"tcp/{router}:{ZENOH_PORT}"]},
        streams=[POSE_STREAM, ROS_STREAM, {**ADVANCED_STREAM, "history": {"samples": 1}}],
    )
    port = api.get("Service", router)["spec"]["ports"][0]["nodePort"]
    town.endpoint = f"tcp/{node.address}:{port}"
    streams = [each["name"] for each in (ROS_STREAM, ADVANCED_STREAM)]

    def flows(what: str) -> None:
        """Wait until samples arrive that are newer than the current ones."""
        before = town.metrics()

        def more(metrics: Mapping[str, float]) -> bool:
            return all(arrived(metrics, each) > arrived(before, each) for each in streams)

        town.wait_metrics(more, f"samples come in {what}")

    with town.vehicles() as vehicles, numbered(town.endpoint) as vehicle:
        vehicle.start()
        vehicles.place(CARS, NEAR)
        deployed, pod = town.wait_deployed(CARS), town.wait_running(CARS)
        flows("at first")

        (first,) = running_pods(api, router)
        with suppress(RuntimeError):  # the container ends with its first process
            node.plane.kubectl("-n", api.namespace, "exec", first["metadata"]["name"], "--", "python3", "-c", CRASH)
        api.wait_for("Pod", first["metadata"]["name"], lambda raw: restarts_of(raw) == 1, what="the router crashed")
        wait_available(api, router)
        flows("after the router's crash")
        vehicles.place(CARS, BETWEEN)

        api.patch("Deployment", router, {"spec": {"replicas": 0}})
        api.wait_list("Pod", lambda pods: not pods, labels=f"app={router}", what="the router is removed")
        vehicles.place(VANS, NEAR)
        vehicle.wait_sent(LOST)
        api.patch("Deployment", router, {"spec": {"replicas": 1}})
        wait_available(api, router)
        flows("from another router in its place")
        town.wait_running(VANS)

        sent = vehicle.stop()
        for stream in streams:
            known = town.wait_metrics(
                lambda metrics, stream=stream: arrived(metrics, stream) + missed(metrics, stream) == sent,  # type: ignore[misc]
                f"of the {sent} samples of {stream} that were sent, each arrived or is counted as missed",
            )
            assert missed(known, stream) >= LOST
        same = town.wait_running(CARS)
        assert same["metadata"]["uid"] == pod["metadata"]["uid"]
        assert untouched(deployed, town.deployment(CARS))
        assert town.live() == {"+".join(CARS), "+".join(VANS)}
        town.settled()
    assert [restarts_of(program) for program in town.programs()] == [0, 0]
