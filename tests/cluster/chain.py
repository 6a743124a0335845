"""The whole chain for a test: vehicles at the positions that the test sets, both programs, and the resulting objects.

The rule starts an episode for two vehicles closer than 150 m and ends it beyond 200 m, so at 175 m only an episode that
is open already keeps its demand. The template makes one Deployment for each pair.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from detector.streams.zenoh import open_session
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, start_manager, wait_settled
from tests.cluster.processes import Process, Processes
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from tests.ros_messages import cdr, pose_stamped
from wayside.api.zenoh import Zenoh, ZenohMode

NEAR, BETWEEN, FAR = 100.0, 175.0, 250.0
"""Metres: NEAR starts an episode; BETWEEN keeps an open one but starts none; FAR ends it."""

HOLDER = "town"
PERIOD = 0.1  # s between two poses of a vehicle

Pair = tuple[str, str]
CARS: Pair = ("car1", "car2")
VANS: Pair = ("van1", "van2")
BUSES: Pair = ("bus1", "bus2")
TRAMS: Pair = ("tram1", "tram2")
LANES = {CARS: 0.0, VANS: 10_000.0, BUSES: 20_000.0, TRAMS: 30_000.0}
"""The y coordinate of each pair in metres: pairs are never close to each other."""


def json_pose(x: float, y: float) -> bytes:
    return json.dumps({"x": x, "y": y}).encode()


def cdr_pose(x: float, y: float) -> bytes:
    now = time.time_ns()
    return cdr(pose_stamped(x, y, seconds=now // 10**9, nanoseconds=now % 10**9))


class Vehicles:
    """Publishes each vehicle's pose ten times a second, at the last set position."""

    def __init__(self, endpoint: str, encode: Callable[[float, float], bytes] = json_pose) -> None:
        self._encode = encode
        self._where: dict[str, tuple[float, float]] = {}
        self._instead: dict[str, Callable[[], bytes]] = {}
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        self._session = open_session(Zenoh(mode=ZenohMode.PEER, connect=[endpoint]))
        self._thread = threading.Thread(target=self._run, daemon=True)

    def place(self, pair: Pair, distance: float) -> None:
        """Set the distance between the two (metres)."""
        with self._lock:
            self._where[pair[0]] = (0.0, LANES[pair])
            self._where[pair[1]] = (distance, LANES[pair])

    def instead(self, vehicle: str, payload: Callable[[], bytes] | None) -> None:
        """Let the vehicle send these payloads instead of its pose; None: its pose again."""
        with self._lock:
            if payload is None:
                self._instead.pop(vehicle, None)
            else:
                self._instead[vehicle] = payload

    def send(self, key: str, payload: bytes) -> None:
        """Publish one message."""
        self._session.put(key, payload)

    def __enter__(self) -> Vehicles:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        self._session.close()  # type: ignore[no-untyped-call]
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            while not self._ended.wait(PERIOD):
                with self._lock:
                    for vehicle, (x, y) in self._where.items():
                        own = self._instead.get(vehicle)
                        self.send(f"vehicles/{vehicle}/pose", self._encode(x, y) if own is None else own())
        except BaseException as failure:  # noqa: BLE001  raised in the test at the end of its block
            self._failure = failure


class PairsNamespace:
    """A namespace in which the demands of pairs are served, wherever the programs run.

    Attributes:
        api: for the namespace.
        patience: seconds that each wait may take.
    """

    def __init__(self, api: Api, patience: float = PATIENCE) -> None:
        self.api = api
        self.patience = patience

    def apply(self, *manifests: Object) -> None:
        """Apply the manifests in the namespace."""
        for manifest in manifests:
            metadata = {**manifest["metadata"], "namespace": self.api.namespace}
            self.api.apply({**manifest, "metadata": metadata})

    def task(self, pair: Pair) -> Object | None:
        """The pair's live task, if any; AssertionError if there are several."""
        found = [task for task in self.api.list("ApplicationTask") if _is_of(task, pair) and _live(task)]
        assert len(found) < 2, f"one demand has several tasks: {found}"
        return found[0] if found else None

    def wait_task(self, pair: Pair) -> Object:
        """Wait for the pair's task."""
        return self._wait(lambda: self.task(pair), f"{pair} has a task")

    def deployment(self, pair: Pair) -> Object | None:
        """The pair's Deployment, if there is one."""
        found = self.api.list("Deployment", labels=f"pair={'-'.join(pair)}")
        assert len(found) < 2, f"{pair} has several Deployments"
        return found[0] if found else None

    def wait_deployed(self, pair: Pair) -> Object:
        """Wait for the pair's Deployment."""
        return self._wait(lambda: self.deployment(pair), f"{pair} has a Deployment")

    def wait_removed(self, pair: Pair) -> None:
        """Wait until the pair's Deployment is deleted."""
        what = f"{pair} has no Deployment"
        wait_until(lambda: self.deployment(pair), lambda it: it is None, timeout=self.patience, what=what)

    def live(self) -> set[str]:
        """The subjects of all live tasks."""
        return {str(task["spec"]["event"]["subject"]) for task in self.api.list("ApplicationTask") if _live(task)}

    def wait_condition(self, kind: str, name: str, type_: str, status: str) -> Object:
        """Wait until the object has the condition with this status; return the condition."""
        found = self.api.wait_for(
            kind,
            name,
            lambda it: condition(it, type_).get("status") == status,
            timeout=self.patience,
            what=f"{name} is {type_}={status}",
        )
        return condition(found, type_)

    def settled(self) -> None:
        """Wait until the cluster has exactly the objects that its live tasks demand."""
        wait_settled(self.api, timeout=self.patience)

    def _wait(self, read: Callable[[], Object | None], what: str) -> Object:
        found = wait_until(read, lambda it: it is not None, timeout=self.patience, what=what)
        assert found is not None
        return found


class Chain(PairsNamespace):
    """Both programs, as processes, on a namespace with a Detector, a rule and a template."""

    def __init__(self, api: Api, namespace: str, processes: Processes, folder: Path) -> None:
        super().__init__(api)
        self.namespace = namespace
        self.processes = processes
        self.folder = folder
        self.endpoint = free_endpoint()
        self.detector: Process | None = None
        self.manager: Process | None = None

    def start(self, *options: str, rules: int = 1) -> Process:
        """Start both programs and wait until they are ready. `options` are the detector's."""
        self.manager = start_manager(self.processes, self.namespace)
        self.detector = self.processes.start(
            "detector", "run", "--name", HOLDER, "--namespace", self.namespace, "--output", str(self.folder), *options
        )
        self.detector.wait_for_output(f"Detector {HOLDER} runs with {rules} rules")
        return self.detector

    def events(self, *subject: str) -> list[Object]:
        """The events of a client or pair that the detector has written so far, without an incomplete last line."""
        file = self.folder / "events.jsonl"
        whole, _, _ = file.read_bytes().rpartition(b"\n") if file.exists() else (b"", b"", b"")
        lines = whole.decode().splitlines()
        return [event for event in map(json.loads, lines) if event["subject"] == "+".join(subject)]

    def wait_events(self, pair: Pair, *kinds: str) -> list[Object]:
        """Wait until the pair's events are of these kinds (`started`, or the reason of an end)."""
        return wait_until(
            lambda: self.events(*pair),
            lambda events: [kind_of(event) for event in events] == list(kinds),
            what=f"the events of {pair} are {kinds}",
        )


def detector(endpoint: str, **spec: Any) -> Object:
    """The Detector. Its long timeouts keep clients and episodes on slow machines."""
    pose = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json", "staleAfter": "2s"}
    full = {
        "zenoh": {"mode": "peer", "listen": [endpoint]},
        "streams": [pose],
        "ruleSelector": {"matchLabels": {"site": HOLDER}},
        "clientTimeout": "10m",
        **spec,
    }
    return _object("Detector", HOLDER, full)


def cdr_stream() -> Object:
    return {
        "name": "pose",
        "key": "vehicles/${client:*}/pose",
        "encoding": "cdr",
        "type": "geometry_msgs/msg/PoseStamped",
        "staleAfter": "2s",
    }


def rule(name: str = "close", *, position: str = "msg", **spec: Any) -> Object:
    deploy = {"templateName": "recorder", "parameters": {"vehicles": "${[a.client, b.client]}"}}
    full = {
        "scope": {
            "pairs": {
                "position": {"stream": "pose", "x": f"{position}.x", "y": f"{position}.y", "maxAge": "2s"},
                "within": 400,
            }
        },
        "evaluation": {"every": "200ms"},
        "when": "distance < 150",
        "until": "distance > 200",
        "actions": [{"name": "record", "deploy": deploy}],
        **spec,
    }
    made = _object("EventRule", name, full)
    made["metadata"]["labels"] = {"site": HOLDER}
    return made


def recording(**parameters: Any) -> list[Object]:
    """The rule's actions, with additional parameters for the template."""
    given = {"vehicles": "${[a.client, b.client]}", **parameters}
    return [{"name": "record", "deploy": {"templateName": "recorder", "parameters": given}}]


def template(*, linger: str = "1s", after: str = "10m") -> Object:
    """The template `recorder`.

    Args:
        linger: how long the application outlives its demand.
        after: how long the demands of a holder outlive its Lease of 15 s. The default leaves enough time for a restart
            on a slow machine.
    """
    labels = {"pair": "${parameters.vehicles[0]}-${parameters.vehicles[1]}"}
    container = {"name": "main", "image": "app:1", "args": ["--rate=${parameters.rate}"]}
    deployment = {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": "${instance.name}", "labels": labels},
        "spec": {
            "replicas": 1,
            "selector": {"matchLabels": labels},
            "template": {"metadata": {"labels": labels}, "spec": {"containers": [container]}},
        },
    }
    spec = {
        "parameters": {
            "vehicles": {"type": "array", "items": "string", "required": True, "merge": "Same"},
            "rate": {"type": "number", "default": 1, "minimum": 1, "maximum": 50, "merge": "Max"},
        },
        "key": "${parameters.vehicles}",
        "lifecycle": {"linger": linger, "onDetectorLoss": {"policy": "Release", "after": after}},
        "manifests": [deployment],
    }
    return _object("ApplicationTemplate", "recorder", spec)


def untouched(before: Object, after: Object | None) -> bool:
    """Whether it is the same object with an unchanged spec."""
    return after is not None and all(
        after["metadata"][field] == before["metadata"][field] for field in ("uid", "generation")
    )


def _object(kind: str, name: str, spec: Object) -> Object:
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec}


def _is_of(task: Object, pair: Pair) -> bool:
    return bool(task["spec"]["event"]["subject"] == "+".join(pair))


def _live(task: Object) -> bool:
    return "endTime" not in task["spec"]


def kind_of(event: Object) -> str:
    """`started`, or the reason for which the episode ended."""
    return "started" if event["type"].endswith(".started") else str(event["data"]["reason"])
