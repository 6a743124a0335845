"""Event → container running, beside a bare `kubectl apply` of the same Deployment on the same node, in the same run.

A real node with both programs as pods: two vehicles come close outside the cluster; from the startTime of the event
until the container of the recorder runs. In turn with it, and by turns before and after it: from the start of `kubectl
apply` of the very Deployment that the manager made, under another name, until its container runs; and the same with one
bare request instead of kubectl, the lower bound. One observer detects all ends and lists every 20 ms.
The first round warms up and does not count. Needs root. Exits with 1 where the ratio of the medians misses its target.

    python -m benchmarks.event_to_container [--rounds 24]
"""

from __future__ import annotations

import argparse
import copy
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import yaml

from tests.cluster.api import Api, Object
from tests.cluster.crds import CRDS
from tests.cluster.namespaces import fresh_namespace
from tests.e2e.images import WAYSIDE_IMAGE, wayside_archive
from tests.e2e.node import Node
from tests.e2e.wayside_in_cluster import EXAMPLE, apply_example, run_town

sys.path.insert(0, str(EXAMPLE))

from cooperative_recording.parked import ParkedVehicles
from cooperative_recording.vehicles import LIDAR_VEHICLES

TARGET = 1.2  # the maximum of the median of events, as a multiple of that of kubectl apply
PATIENCE = 300.0  # s
LOOK = 0.02  # s between two lists
WAIT = ["python3", "-c", "import time; time.sleep(10**6)"]
EVENT, KUBECTL, REQUEST = "event", "kubectl apply", "one request"
Seconds = dict[str, list[float]]


def main() -> int:
    """Measure and print; 1 means that the target was missed."""
    parser = argparse.ArgumentParser(prog="event_to_container", description=__doc__)
    parser.add_argument("--rounds", type=int, default=24, help="of each kind (%(default)s)")
    options = parser.parse_args()
    if os.geteuid() != 0:
        print("a real node needs root: not measured")
        return 0
    with Node(crds=CRDS) as node, tempfile.TemporaryDirectory() as folder:
        node.load(wayside_archive(Path(folder)))
        with fresh_namespace(node.api(), "event-to-container") as namespace:
            seconds = measure(node, node.api(namespace), options.rounds)
    print(f"→ container running, {options.rounds} rounds    median      p90    worst")
    for name, taken in seconds.items():
        figures = (statistics.median(taken), ninetieth(taken), max(taken))
        print(f"{name:34}{''.join(f'{figure:7.2f} s' for figure in figures)}")
    ratios = [figure(seconds[EVENT]) / figure(seconds[KUBECTL]) for figure in (statistics.median, ninetieth, max)]
    print(f"{EVENT} : {KUBECTL:26}{''.join(f'{ratio:7.2f}  ' for ratio in ratios)} (target of the medians {TARGET})")
    return 0 if ratios[0] <= TARGET else 1


def ninetieth(seconds: list[float]) -> float:
    """The 90th percentile."""
    return statistics.quantiles(seconds, n=10, method="inclusive")[-1] if len(seconds) > 1 else seconds[0]


def measure(node: Node, api: Api, rounds: int) -> Seconds:
    """Return the seconds of each round, by kind."""
    first, second = (vehicle.name for vehicle in LIDAR_VEHICLES[:2])
    apply_example(api, WAYSIDE_IMAGE, WAIT)
    rule = api.list("EventRule")[0]
    record = [action for action in rule["spec"]["actions"] if action["name"] == "record"]
    api.patch("EventRule", rule["metadata"]["name"], {"spec": {"actions": record}})
    port = run_town(api, WAYSIDE_IMAGE)
    taken: Seconds = {EVENT: [], KUBECTL: [], REQUEST: []}
    made: Object = {}
    with ParkedVehicles([f"tcp/{node.address}:{port}"], wait_s=PATIENCE) as vehicles:
        vehicles.put(first, 0)

        def by_event() -> float:
            vehicles.put(second, 100)
            until = _running(api)
            (task,) = [each for each in api.list("ApplicationTask") if "endTime" not in each["spec"]]
            began = datetime.fromisoformat(task["spec"]["event"]["startTime"][:26] + "+00:00").timestamp()
            made.update(next(each for each in api.list("Deployment") if _is_recorder(each)))
            vehicles.put(second, 1000)
            return until - began

        ways: dict[str, Callable[[], float]] = {
            EVENT: by_event,
            KUBECTL: lambda: _by_hand(node, api, made),
            REQUEST: lambda: _by_request(api, made),
        }
        for number in range(rounds + 1):
            turn = list(ways)[:: 1 if number % 2 == 0 else -1]
            for name in turn:
                seconds = ways[name]()
                _gone(api)
                if number > 0:
                    taken[name].append(seconds)
    return taken


def _by_hand(node: Node, api: Api, made: Object) -> float:
    """Apply a Deployment like the one made with kubectl, measure, and delete it."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        yaml.safe_dump(_alike(made), file)
        file.flush()
        command = [str(node.binaries.kubectl), f"--kubeconfig={node.plane.kubeconfig}", "-n", api.namespace]
        began = time.time()
        with subprocess.Popen([*command, "apply", "-f", file.name], stdout=subprocess.DEVNULL):
            until = _running(api)
    api.delete("Deployment", "by-hand")
    return until - began


def _by_request(api: Api, made: Object) -> float:
    """The same with one request of a connected client."""
    manifest = _alike(made)
    began = time.time()
    api.apply(manifest)
    until = _running(api)
    api.delete("Deployment", "by-hand")
    return until - began


def _alike(made: Object) -> Object:
    """A copy of the Deployment under another name and labels."""
    spec = copy.deepcopy(made["spec"])
    labels = spec["template"]["metadata"]["labels"] | {"app.kubernetes.io/instance": "by-hand"}
    spec["template"]["metadata"]["labels"] = {k: v for k, v in labels.items() if "wayside" not in k}
    spec["selector"]["matchLabels"] = {"app.kubernetes.io/instance": "by-hand"}
    return {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": {"name": "by-hand"}, "spec": spec}


def _running(api: Api) -> float:
    """Wait until a recorder's container runs; return the time in seconds since the epoch."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        for pod in api.list("Pod", labels="app.kubernetes.io/name=scene-recorder"):
            if any("running" in each["state"] for each in pod["status"].get("containerStatuses", [])):
                return time.time()
        time.sleep(LOOK)
    raise TimeoutError(f"no container of a recorder runs after {PATIENCE:g} s")


def _gone(api: Api) -> None:
    what = "the recorder is removed"
    api.wait_list("Pod", lambda found: not found, what=what, labels="app.kubernetes.io/name=scene-recorder")


def _is_recorder(deployment: Object) -> bool:
    return str(deployment["metadata"]["name"]).startswith("scene-recorder")


if __name__ == "__main__":
    sys.exit(main())
