"""How much later a pod's own container runs, and how much later the pod is gone, with a detector in it.

A real node with the chart installed: pods that ask for a detector, the same with a native sidecar that does nothing,
and with none, by turns. From the request that makes the pod until its own container is seen to run, and from the
request that deletes it, while all are at work, until it is gone; looked at every 20 ms. The first round warms up and
does not count. Needs root.

    python -m benchmarks.sidecar_start [--rounds 8]
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.cluster.api import Api, Object
from tests.cluster.crds import CRDS
from tests.cluster.expected_objects import condition
from tests.cluster.namespaces import fresh_namespace
from tests.e2e.images import WAYSIDE_IMAGE, wayside_archive
from tests.e2e.node import Node
from tests.e2e.released import MANAGER, RELEASE, available, image_values
from tests.e2e.test_sidecar import DETECTOR, pod_spec, resources, sidecar_of
from tests.helm import ensure_tools
from tests.helm.wayside_chart import CHART, Helm
from tests.patience import NODE_PATIENCE

LOOK = 0.02  # s between two looks
PROGRAM = """
import signal, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
print("runs", flush=True)
signal.pause()
"""
DETECTED, IDLE, ALONE = "with a detector", "with an idle sidecar", "alone"
KINDS = (DETECTED, IDLE, ALONE)
Seconds = dict[str, list[float]]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="sidecar_start", description=__doc__)
    parser.add_argument("--rounds", type=int, default=8, help="of each kind (%(default)s)")
    rounds = parser.parse_args().rounds
    if os.geteuid() != 0:
        print("a real node needs root: not measured")
        return 0
    with Node(crds=CRDS) as node, tempfile.TemporaryDirectory() as folder:
        node.load(wayside_archive(Path(folder)))
        with fresh_namespace(node.api(), "sidecar-start") as namespace:
            helm = Helm(ensure_tools().helm, Path(folder) / "home", node.plane.kubeconfig)
            stored, starts, ends = measure(node.api(namespace), helm, rounds)
    print(f"| {rounds} rounds: median, worst | {' | '.join(KINDS)} | ratio to an idle sidecar |")
    print("|---|---|---|---|---|")
    steps = (("made → stored", stored), ("made → its own container runs", starts), ("deleted → gone", ends))
    for what, taken in steps:
        figures = " | ".join(f"{statistics.median(taken[kind]):.2f} s, {max(taken[kind]):.2f} s" for kind in KINDS)
        print(f"| {what} | {figures} | {statistics.median(taken[DETECTED]) / statistics.median(taken[IDLE]):.2f} |")
    return 0


def measure(api: Api, helm: Helm, rounds: int) -> tuple[Seconds, Seconds, Seconds]:
    """The seconds until the pod is stored, until its own container runs, and until it is gone, by kind."""
    given = {"image": image_values(WAYSIDE_IMAGE), "crds": {"install": False}}
    given["manager"] = {"namespaces": [api.namespace]}
    helm("install", RELEASE, str(CHART), "--namespace", api.namespace, values=given)
    api.wait_for("Deployment", MANAGER, available, timeout=NODE_PATIENCE, what="the manager is available")
    for each in resources(WAYSIDE_IMAGE):
        api.apply(each)
    api.wait_for(
        "Detector",
        DETECTOR,
        lambda raw: condition(raw, "Running").get("reason") == "InPods",
        timeout=NODE_PATIENCE,
        what="the accounts have their rights",
    )
    taken: list[Seconds] = [{kind: [] for kind in KINDS} for _ in range(3)]
    for number in range(rounds + 1):
        for kind in KINDS[:: 1 if number % 2 == 0 else -1]:
            name = f"car-{number}-{KINDS.index(kind)}"
            for each, seconds in zip(taken, one(api, name, kind), strict=True):
                if number > 0:
                    each[kind].append(seconds)
    stored, starts, ends = taken
    return stored, starts, ends


def one(api: Api, name: str, kind: str) -> tuple[float, float, float]:
    """Make a pod and delete it; the seconds until it is stored, runs, and, once it is deleted, is gone."""
    labels = {"wayside.dev/detector": DETECTOR} if kind == DETECTED else {}
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name, "labels": labels}}
    spec = pod_spec(WAYSIDE_IMAGE, PROGRAM)
    spec["automountServiceAccountToken"] = True  # as most pods have it: a volume takes the kubelet some time
    if kind == IDLE:
        (own,) = spec["containers"]
        spec["initContainers"] = [own | {"name": "idle", "restartPolicy": "Always"}]
    began = time.monotonic()
    api.create(pod | {"spec": spec})
    stored = time.monotonic() - began
    started = until(lambda: runs(api.get("Pod", name))) - began
    for container in ("main", *(["idle"] if kind == IDLE else [])):
        log = f"/api/v1/namespaces/{api.namespace}/pods/{name}/log?container={container}"
        until(lambda log=log: "runs" in api.raw(log))
    if kind == DETECTED:
        if not sidecar_of(api.get("Pod", name)):
            sys.exit(f"pod {name} has no detector")
        api.wait_for(
            "Lease", f"wayside-{DETECTOR}.{name}", lambda _: True, timeout=NODE_PATIENCE, what="its detector works"
        )
    began = time.monotonic()
    api.delete("Pod", name)
    return stored, started, until(lambda: api.find("Pod", name) is None) - began


def runs(pod: Object) -> bool:
    """Whether the pod's own container runs."""
    return any("running" in each["state"] for each in pod.get("status", {}).get("containerStatuses", []))


def until(holds: Callable[[], bool]) -> float:
    """When it holds at last, on the monotonic clock."""
    deadline = time.monotonic() + NODE_PATIENCE
    while not holds():
        if time.monotonic() > deadline:
            sys.exit(f"not within {NODE_PATIENCE:g} s")
        time.sleep(LOOK)
    return time.monotonic()


if __name__ == "__main__":
    sys.exit(main())
