"""The pairs of `tests.cluster.chain` on a real node: both programs and the applications run in pods."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from detector.streams.zenoh import open_session
from tests.cluster.api import Api, ApiError, Object, Objects, Unreachable
from tests.cluster.chain import HOLDER, Pair, PairsNamespace, Vehicles, detector, kind_of, rule, template
from tests.cluster.waiting import wait_until
from tests.e2e.node import Node
from tests.e2e.wayside_in_cluster import METRICS_PORT, ZENOH_PORT, apply_manager, expose_detector
from tests.e2e.workloads import wait_available
from tests.patience import NODE_PATIENCE
from wayside.api.zenoh import Zenoh, ZenohMode

MANAGER = "app=application-manager"
DETECTOR = f"wayside.dev/runs={HOLDER}"
IDLE = ["python3", "-c", "import time; time.sleep(10**6)"]


class PairsOnNode(PairsNamespace):
    """Both programs as pods, with a Detector, a rule and a template.

    Attributes:
        endpoint: where vehicles reach the detector from outside, once it is started.
    """

    def __init__(self, node: Node, api: Api, image: str) -> None:
        super().__init__(api, NODE_PATIENCE)
        self.node = node
        self.image = image
        self.endpoint = ""

    def start(self, *, after: str = "10m", **spec: Any) -> None:
        """Start both and wait until they are ready.

        Args:
            after: how long demands outlive the detector's Lease.
            spec: more fields of the Detector's spec.
        """
        self.apply(self.runnable(template(after=after)), rule())
        self.apply(detector(f"tcp/0.0.0.0:{ZENOH_PORT}", mode="Standalone", **spec))
        apply_manager(self.api, self.image)
        self.endpoint = f"tcp/{self.node.address}:{expose_detector(self.api, HOLDER)}"
        wait_available(self.api, "application-manager")
        self.wait_condition("Detector", HOLDER, "Running", "True")

    def runnable(self, made: Object) -> Object:
        """The template, with a container that runs until it is stopped."""
        for manifest in made["spec"]["manifests"]:
            pod = manifest["spec"]["template"]["spec"]
            (container,) = pod["containers"]
            container |= {"image": self.image, "imagePullPolicy": "Never", "command": IDLE}
            pod["terminationGracePeriodSeconds"] = 1
        return made

    def pods(self, pair: Pair) -> Objects:
        """All pods of the pair's application, also those that are ending."""
        return self.api.list("Pod", labels=f"pair={'-'.join(pair)}")

    def wait_running(self, pair: Pair, *, restarts: int = 0) -> Object:
        """Wait until the pair's application is one ready pod whose container was restarted this number of times;
        return it."""
        what = f"one pod of {pair} is ready after {restarts} restarts"

        def holds(pods: Objects) -> bool:
            return len(pods) == 1 and is_ready(pods[0]) and restarts_of(pods[0]) == restarts

        return wait_until(lambda: self.pods(pair), holds, timeout=NODE_PATIENCE, what=what, diagnose=self.reported)[0]

    def wait_no_pods(self, pair: Pair) -> None:
        """Wait until no pod of the pair's application is left."""
        what = f"no pod of {pair} is left"
        wait_until(
            lambda: self.pods(pair), lambda pods: not pods, timeout=NODE_PATIENCE, what=what, diagnose=self.reported
        )

    def programs(self) -> Objects:
        """The pods of the manager and the detector, also those that are ending."""
        return [pod for labels in (MANAGER, DETECTOR) for pod in self.api.list("Pod", labels=labels)]

    def wait_programs(self, *, restarts: int = 0) -> None:
        """Wait until each program is one ready pod whose container was restarted this number of times."""

        def holds(pods: Objects) -> bool:
            return len(pods) == 2 and all(is_ready(pod) and restarts_of(pod) == restarts for pod in pods)

        what = f"both programs are ready after {restarts} restarts"
        wait_until(self.programs, holds, timeout=NODE_PATIENCE, what=what, diagnose=self.reported)

    def metrics(self, labels: str = DETECTOR) -> Mapping[str, float]:
        """The metrics of the program in the pod with these labels, by name with labels as in `/metrics`."""
        (pod,) = self.api.list("Pod", labels=labels)
        path = f"/api/v1/namespaces/{self.api.namespace}/pods/{pod['metadata']['name']}:{METRICS_PORT}/proxy/metrics"
        lines = [line for line in self.api.raw(path).splitlines() if line and not line.startswith("#")]
        return {name: float(value) for name, _, value in (line.rpartition(" ") for line in lines)}

    def wait_metrics(
        self, holds: Callable[[Mapping[str, float]], bool], what: str, labels: str = DETECTOR
    ) -> Mapping[str, float]:
        """Wait until `holds` is true for the metrics."""
        transient = (ApiError, Unreachable, ValueError)  # the pod may not be running yet
        return wait_until(lambda: self.metrics(labels), holds, timeout=NODE_PATIENCE, what=what, transient=transient)

    def vehicles(self) -> Vehicles:
        """Vehicles outside the cluster."""
        return Vehicles(self.endpoint)

    def reported(self) -> str:
        """The ends of the programs' logs, for messages."""
        try:
            names = [pod["metadata"]["name"] for pod in self.programs()]
            logs = ("--namespace", self.api.namespace, "logs", "--tail=20")
            return "\n".join(f"--- {name}\n{self.node.plane.kubectl(*logs, name)}" for name in names)
        except (ApiError, Unreachable, RuntimeError) as error:
            return f"no logs: {error}"


class PublishedEvents:
    """The events that a detector publishes, from outside the cluster; a context manager."""

    def __init__(self, endpoint: str) -> None:
        self._lock = threading.Lock()
        self._events: Objects = []
        self._session = open_session(Zenoh(mode=ZenohMode.PEER, connect=[endpoint]))
        self._subscriber = self._session.declare_subscriber("wayside/events/**", self._take)

    def kinds(self, pair: Pair) -> list[str]:
        """`started`, or the reasons of ends, of the pair so far."""
        with self._lock:
            return [kind_of(event) for event in self._events if event["subject"] == "+".join(pair)]

    def wait(self, pair: Pair, *kinds: str) -> None:
        """Wait until the pair's events are these."""
        what = f"the events of {pair} are {kinds}"
        wait_until(lambda: self.kinds(pair), lambda found: found == list(kinds), timeout=NODE_PATIENCE, what=what)

    def __enter__(self) -> PublishedEvents:
        # It connects in the background; earlier messages are lost.
        wait_until(self._session.info.peers_zid, bool, timeout=NODE_PATIENCE, what="the detector is connected")
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def _take(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._events.append(json.loads(sample.payload.to_bytes()))


def is_ready(pod: Object) -> bool:
    """Whether the pod is ready and not being deleted."""
    conditions = {each["type"]: each["status"] for each in pod["status"].get("conditions", [])}
    return conditions.get("Ready") == "True" and "deletionTimestamp" not in pod["metadata"]


def restarts_of(pod: Object) -> int:
    """The number of restarts of the pod's containers."""
    return sum(status["restartCount"] for status in pod["status"].get("containerStatuses", []))
