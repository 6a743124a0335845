"""A detector's start in its container on a real node → its first subscription; and the sizes of the image's layers.

The pod is as the manager makes it, and the detector reads its Detector from the API server. Beside it, in turn, the
least that a program with Zenoh takes, in the same image. Each begins when its container's first process does, which
logs it, and ends when a publisher outside the cluster sees a listener; how long the node took to make the container is
measured too. The first round warms up and does not count. Needs root. Exits with 1 where the median start misses its
goal.

    python -m benchmarks.container_start [--rounds 7]
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import yaml
import zenoh

from application_manager.core.objects.detectors import detector_objects, detector_roles
from application_manager.core.objects.poddefaults import PodDefaults
from benchmarks.detector_start import KEY, LEAST, TARGET_S
from tests.cluster.api import Api, Object
from tests.cluster.crds import CRDS
from tests.cluster.namespaces import fresh_namespace
from tests.cluster.waiting import wait_until
from tests.e2e.images import WAYSIDE_IMAGE, wayside_archive
from tests.e2e.node import Node
from tests.e2e.wayside_in_cluster import EXAMPLE
from tests.ports import free_port
from wayside.api import Detector

PATIENCE = 300.0  # s
STAMP = "import os, sys, time; print(time.time(), flush=True); os.execvp(sys.argv[1], sys.argv[1:])"
POD = "started"
DETECTOR, ZENOH = "detector", "zenoh alone"


def main() -> int:
    """Measure and print; 1 means that the target was missed."""
    parser = argparse.ArgumentParser(prog="container_start", description=__doc__)
    parser.add_argument("--rounds", type=int, default=7, help="of each kind (%(default)s)")
    options = parser.parse_args()
    if os.geteuid() != 0:
        print("a real node needs root: not measured")
        return 0
    with Node(crds=CRDS) as node, tempfile.TemporaryDirectory() as folder:
        archive = wayside_archive(Path(folder))
        node.load(archive)
        print(f"the image: {archive.stat().st_size / 1e6:.0f} MB, uncompressed")
        with fresh_namespace(node.api(), "container-start") as namespace:
            taken = measure(node, node.api(namespace), options.rounds)
    for name, rounds in taken.items():
        seconds = [each for _, each in rounds]
        made = statistics.median(each for each, _ in rounds)
        spread = f"median {statistics.median(seconds):.2f} s, from {min(seconds):.2f} to {max(seconds):.2f} s"
        print(f"{name:12} {spread}; before that its container, in {made:.2f} s")
    start = statistics.median(each for _, each in taken[DETECTOR])
    print(f"target of the detector's start: {TARGET_S:g} s")
    return 0 if start <= TARGET_S else 1


def measure(node: Node, api: Api, rounds: int) -> dict[str, list[tuple[float, float]]]:
    """By kind, for each round: seconds from the pod to its first process, and from there to the subscription."""
    endpoint = f"tcp/{node.enclosure.outside}:{free_port()}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    raw = yaml.safe_load((EXAMPLE / "detector.yaml").read_text())
    raw["spec"] |= {"mode": "Standalone", "zenoh": {"mode": "client", "connect": [endpoint]}}
    detector = Detector.model_validate(api.apply(raw))
    for each in detector_roles(api.namespace, detector.name):
        api.apply(each)
    *_, deployment = detector_objects(detector, PodDefaults(WAYSIDE_IMAGE))
    spec = deployment["spec"]["template"]["spec"] | {"terminationGracePeriodSeconds": 1}
    commands = {DETECTOR: spec["containers"][0]["command"], ZENOH: ["python3", "-c", LEAST, endpoint]}
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
    with zenoh.open(config) as session:
        publisher = session.declare_publisher(KEY)
        for number in range(rounds + 1):
            for name, command in commands.items():
                seconds = _round(node, api, publisher, _pod(spec, command, name))
                if number > 0:
                    taken[name].append(seconds)
    return taken


def _pod(spec: Object, command: list[str], name: str) -> Object:
    container = spec["containers"][0] | {"command": ["python3", "-c", STAMP, *command]}
    if name == ZENOH:  # it has no health endpoint
        container = {key: value for key, value in container.items() if not key.endswith("Probe")}
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": POD},
        "spec": spec | {"containers": [container], "restartPolicy": "Never"},
    }


def _round(node: Node, api: Api, publisher: zenoh.Publisher, pod: Object) -> tuple[float, float]:
    """Create the pod, wait for its subscription, and delete it."""
    created = time.time()
    api.create(pod)
    deadline = time.monotonic() + PATIENCE
    while not publisher.matching_status.matching:  # type: ignore[attr-defined]  # zenoh's stub takes it for a bool
        if time.monotonic() > deadline:
            raise TimeoutError(f"no subscription comes\n{node.plane.kubectl('-n', api.namespace, 'logs', POD)}")
        time.sleep(0.002)
    until = time.time()
    began = float(node.plane.kubectl("--namespace", api.namespace, "logs", POD).partition("\n")[0])
    api.delete("Pod", POD)
    api.wait_gone("Pod", POD, timeout=PATIENCE)
    wait_until(
        lambda: publisher.matching_status.matching,  # type: ignore[attr-defined]
        lambda there: not there,
        timeout=PATIENCE,
        what="nobody listens any more",
    )
    return began - created, until - began


if __name__ == "__main__":
    sys.exit(main())
