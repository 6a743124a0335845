"""The cost of a detector as a sidecar: memory and CPU, idle and with 20 streams at 50 Hz.

Ours: `detector run --name … --as-pod` as in an injected container, with a real API server. The baseline: a Python
program that subscribes to the same keys over Zenoh and does nothing with what comes. Each in turn, idle and then under
load, from a publisher of its own; the publisher is not counted. Memory is what is resident, shared libraries
included; CPU the time used by all threads over the time that went by.

    python -m benchmarks.sidecar_cost [--seconds 20]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from tests.cluster.namespaces import fresh_namespace
from tests.cluster.processes import Processes
from tests.ports import free_endpoint

STREAMS, RATE = 20, 50
WARM = 15.0  # s until the buffer of 10 s is full
LEAST = """
import json, sys, time, zenoh
config = zenoh.Config.from_json5(json.dumps({
    "mode": "peer", "listen": {"endpoints": [sys.argv[1]]}, "scouting": {"multicast": {"enabled": False}},
}))
session = zenoh.open(config)
keys = [f"vehicles/*/stream{n}" for n in range(int(sys.argv[2]))]
subscribers = [session.declare_subscriber(key, lambda sample: None) for key in keys]
print("ready", flush=True)
time.sleep(10**6)
"""
PUBLISH = """
import json, sys, time, zenoh
from tests.ros_messages import cdr, pose_stamped
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client", "connect": {"endpoints": [sys.argv[1]], "timeout_ms": -1},
}))
payload = cdr(pose_stamped(1.0, 2.0, seconds=1, nanoseconds=0))
count, rate = int(sys.argv[2]), int(sys.argv[3])
with zenoh.open(config) as session:
    publishers = [session.declare_publisher(f"vehicles/car1/stream{n}") for n in range(count)]
    began = time.monotonic()
    for round in range(10**9):
        time.sleep(max(0.0, began + round / rate - time.monotonic()))
        for each in publishers:
            each.put(payload)
"""


@dataclass(frozen=True, slots=True)
class Cost:
    """Memory in bytes, and CPU as a part of one core."""

    memory: int
    cpu: float


def cost(pid: int, seconds: float) -> Cost:
    """The CPU time of the process during this number of seconds, and its memory afterwards."""
    before, began = _cpu(pid), time.monotonic()
    time.sleep(seconds)
    used = (_cpu(pid) - before) / (time.monotonic() - began)
    resident = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return Cost(resident * os.sysconf("SC_PAGE_SIZE"), used)


def _cpu(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def both(pid: int, endpoint: str, seconds: float) -> tuple[Cost, Cost]:
    """Idle, and under load."""
    time.sleep(3)
    idle = cost(pid, seconds)
    command = [sys.executable, "-c", PUBLISH, endpoint, str(STREAMS), str(RATE)]
    publisher = subprocess.Popen(command)
    try:
        time.sleep(WARM)
        loaded = cost(pid, seconds)
        if publisher.poll() is not None:
            sys.exit("the publisher has ended")
        return idle, loaded
    finally:
        publisher.kill()
        publisher.wait()


def manifests(endpoint: str) -> Iterator[dict[str, Any]]:
    streams = [
        {
            "name": f"stream{n}",
            "key": f"vehicles/${{client:*}}/stream{n}",
            "encoding": "cdr",
            "type": "geometry_msgs/msg/PoseStamped",
        }
        for n in range(STREAMS)
    ]
    signals = [
        {"name": "x", "stream": "stream0", "value": "msg.pose.position.x"},
        {"name": "most", "stream": "stream1", "value": "msg.pose.position.y", "over": "5s", "aggregate": "Max"},
    ]
    zenoh = {"mode": "peer", "listen": [endpoint], "scouting": False}
    detector = {"mode": "Sidecar", "serviceAccountNames": ["vehicle"], "zenoh": zenoh, "streams": streams}
    rule = {"signals": signals, "evaluation": {"every": "100ms"}, "when": "x > 100 || most > 100"}
    for kind, name, spec in (("Detector", "on-board", detector), ("EventRule", "far", rule)):
        yield {"apiVersion": "wayside.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec}


@contextmanager
def detector(plane: ControlPlane, endpoint: str) -> Iterator[int]:
    """The pid of a detector that runs as in a pod."""
    with fresh_namespace(plane.api(), "sidecar-cost") as namespace, tempfile.TemporaryDirectory() as logs:
        for each in manifests(endpoint):
            plane.api(namespace).create(each)
        processes = Processes(Path(logs), {"KUBECONFIG": str(plane.kubeconfig)})
        try:
            options = ("--name", "on-board", "--namespace", namespace, "--as-pod", "--metrics-port", "0")
            started = processes.start("detector", "run", *options, environment={"POD_NAME": "car-1"})
            started.wait_for_output("Detector on-board runs with 1 rules")
            yield started.pid
        finally:
            processes.kill_all()


@contextmanager
def least(endpoint: str) -> Iterator[int]:
    """The pid of the baseline."""
    command = [sys.executable, "-c", LEAST, endpoint, str(STREAMS)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield process.pid
        finally:
            process.kill()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement (%(default)s)")
    seconds = parser.parse_args().seconds
    endpoint = free_endpoint()
    with least(endpoint) as pid:
        baseline = both(pid, endpoint, seconds)
    endpoint = free_endpoint()
    with ControlPlane(crds=CRDS) as plane, detector(plane, endpoint) as pid:
        ours = both(pid, endpoint, seconds)
    print("| | memory | of a core | bare subscriber: memory | of a core | ratios |")
    print("|---|---|---|---|---|---|")
    for what, mine, other in zip(("idle", f"{STREAMS} streams at {RATE} Hz"), ours, baseline, strict=True):
        ratios = f"{mine.memory / other.memory:.1f}, {mine.cpu / other.cpu:.1f}" if other.cpu else "-"
        print(
            f"| {what} | {mine.memory / 2**20:.0f} MiB | {mine.cpu:.1%} "
            f"| {other.memory / 2**20:.0f} MiB | {other.cpu:.1%} | {ratios} |"
        )


if __name__ == "__main__":
    main()
