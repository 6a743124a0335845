"""The CPU time of one message, one vehicle and one task on this machine: the unit costs of `simulate_scale`.

CPU times and not rates: a rate on a machine that does other work means little. The cost of a message or a
task includes all threads of the program.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import yaml

from application_manager.cluster.client import manager_client
from benchmarks import intake_rate, pairs_speed
from benchmarks.manager_memory import resident
from benchmarks.sidecar_cost import Cost, cost
from benchmarks.task_to_deployment import (
    TASKS,
    TEMPLATE,
    TEMPLATES,
    DeploymentWatch,
    at_once,
    cpu_seconds,
    fresh_namespaces,
    task,
)
from benchmarks.workloads import crowd, speeds
from detector.status.model import read_status
from detector.streams.query_handler import query_detectors
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from tests.ports import free_endpoint
from wayside.api.zenoh import Zenoh, ZenohMode
from wayside.kubernetes.connection import load_configuration

REGION_RULES = 10
"""Of a regional detector; each has a window of 1 to 5 s and is evaluated once a second."""

VEHICLES = 2500
"""Of the region, at one message a second each."""

FILLED = 12
"""Messages of each until its windows and the buffer of 10 s are full."""

CROWD = 5000
"""Clients of the rule about pairs."""

ROUNDS = 5  # of the region
FLOOD = 4.0  # s
ATTEMPTS = 5  # of a flood
PATIENCE = 180.0  # s

_ROUTER = """
import json, sys, threading, zenoh
config = zenoh.Config()
for path, value in (("mode", "router"), ("scouting/multicast/enabled", False), ("listen/endpoints", sys.argv[1:])):
    config.insert_json5(path, json.dumps(value))
session = zenoh.open(config)
print("up", flush=True)
threading.Event().wait()
"""

_DRIVE = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
vehicles, parts = int(sys.argv[2]), 20
rest = {"x": 12345.678, "y": 23456.789, "heading": 1.2345, "acceleration": -0.1234, "assistance": False, "lane": 2}
with zenoh.open(config) as session:
    began = time.monotonic()
    for number in range(10**9):
        late = time.monotonic() - began - number / parts
        began += max(0.0, late - 1 / parts)  # what was missed is skipped: a burst would cost less a message
        time.sleep(max(0.0, -late))
        for vehicle in range(number % parts, vehicles, parts):
            speed = round(27 + 8 * ((number / parts + vehicle) % 9 / 4.5 - 1), 3)
            session.put(f"vehicles/c{vehicle}/speed", json.dumps({"speed": speed, **rest}))
"""


@dataclass(frozen=True)
class UnitCosts:
    """Seconds of CPU time and bytes, as measured."""

    bare_message: float
    """A Zenoh subscriber in Python that only counts, under a flood."""
    detector_message: float
    """A detector with one rule, under the same flood."""
    router_message: float
    """A Zenoh router, from one publisher to one subscriber, at a rate that does not load it."""
    detector_idle: float
    """Cores of a regional detector without vehicles."""
    vehicle_second: float
    """Of a regional detector, for a vehicle with one message a second: received, buffered, in windows of ten rules."""
    vehicle_second_most: float
    """The largest of the runs: where other programs use the same caches and cores, it costs a multiple."""
    detector_bytes: float
    vehicle_bytes: float
    """Resident memory of the detector, and more for each vehicle."""
    pair_second: float
    """Of a rule about pairs, for a vehicle with three others within reach, evaluated once a second."""
    manager_start: float
    """Of the manager, from a new task to its Deployment with all statuses."""
    manager_end: float
    """Of the manager, from the end of the task until all is deleted, the task too."""
    cluster_task: float
    """API server, etcd and controller manager, over both."""
    writes: float
    """Requests to the API server that change something, over both, from all."""
    task_bytes: float
    """JSON of the task and of all that follows from it: instance, Deployment, ReplicaSet, pod, Events."""
    manager_bytes: float
    manager_task_bytes: float
    """Resident memory of the manager, and more for each open task."""


def measure(tasks: int, seconds: float) -> UnitCosts:
    """Measure all; `tasks` at once for the manager, `seconds` for each reading of the detector."""
    bare, detector = flood()
    _, idle, _ = region(0, seconds)
    runs = [region(VEHICLES, seconds) for _ in range(ROUNDS)]
    return UnitCosts(
        bare_message=bare,
        detector_message=detector,
        router_message=statistics.median(router.cpu / rate for router, _, rate in runs),
        detector_idle=idle.cpu,
        vehicle_second=statistics.median((ours.cpu - idle.cpu) / rate for _, ours, rate in runs),
        vehicle_second_most=max((ours.cpu - idle.cpu) / rate for _, ours, rate in runs),
        detector_bytes=idle.memory,
        vehicle_bytes=statistics.median((ours.memory - idle.memory) / VEHICLES for _, ours, _ in runs),
        pair_second=statistics.median(pairs_speed.measure(list(crowd.parts(CROWD, 4))).ticks) / CROWD,
        **manager(tasks),
    )


def flood() -> tuple[float, float]:
    """Seconds of CPU a message: a bare callback, and a detector."""
    options = argparse.Namespace(seconds=FLOOD, rules=1, clients=100)
    return _a_message(intake_rate.BARE, options), _a_message(intake_rate.DETECTOR, options)


def _a_message(receiver: str, options: argparse.Namespace) -> float:
    for attempt in range(1, ATTEMPTS + 1):
        try:
            run = intake_rate.measure(receiver, 1, options)
        except SystemExit:  # a busy machine may lose messages, and then the run does not count
            if attempt == ATTEMPTS:
                raise
        else:
            return float(sum(run.report["stages"].values()) / run.count * 1e-9)
    raise AssertionError


def region(vehicles: int, seconds: float) -> tuple[Cost, Cost, float]:
    """What the router (without its memory) and the detector take with this number of vehicles; messages a second.

    A machine that does other work delays the vehicles, so the messages are counted.
    """
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder, _router(endpoint) as router:
        files = _documents(Path(folder), endpoint)
        command = [str(Path(sys.executable).with_name("detector")), "run", "--output", str(Path(folder) / "out")]
        with (Path(folder) / "log").open("w") as log:
            detector = subprocess.Popen([*command, "--detector", str(files[0]), "--rules", str(files[1])], stderr=log)
            driving = subprocess.Popen([sys.executable, "-c", _DRIVE, endpoint, str(vehicles)])
            try:
                _samples(endpoint, vehicles * FILLED)
                first, before, began = _samples(endpoint), cpu_seconds(router), time.monotonic()
                ours = cost(detector.pid, seconds)
                elapsed = time.monotonic() - began
                theirs = Cost(0, (cpu_seconds(router) - before) / elapsed)
                return theirs, ours, (_samples(endpoint) - first) / elapsed
            finally:
                for process in (driving, detector):
                    process.kill()
                    process.wait()


def _samples(endpoint: str, least: int = 0) -> int:
    """How many samples the detector has received, once these are there."""
    network, end = Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint]), time.monotonic() + PATIENCE
    while time.monotonic() < end:
        (answer,) = query_detectors(network, "speeds", "status", {}, PATIENCE)
        samples = sum(stream.samples for stream in read_status(answer.payload).streams)
        if samples >= least:
            return samples
        time.sleep(0.5)
    raise SystemExit(f"the detector has not received {least} samples within {PATIENCE:g} s")


@contextmanager
def _router(endpoint: str) -> Iterator[int]:
    with subprocess.Popen([sys.executable, "-c", _ROUTER, endpoint], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield process.pid
        finally:
            process.kill()


def _documents(folder: Path, endpoint: str) -> tuple[Path, Path]:
    detector, rules = folder / "detector.yaml", folder / "rules.yaml"
    document = speeds.detector_document()
    document["spec"]["zenoh"] = {"mode": "client", "connect": [endpoint]}
    detector.write_text(yaml.safe_dump(document))
    made = [speeds.rule_document(each, {"every": "1s"}) for each in speeds.limits(REGION_RULES)]
    rules.write_text(yaml.safe_dump_all(made))
    return detector, rules


def manager(tasks: int) -> dict[str, float]:
    """The fields about the manager and the cluster."""
    with ControlPlane(crds=CRDS) as plane, tempfile.TemporaryFile() as log:
        os.environ["KUBECONFIG"] = str(plane.kubeconfig)
        namespace, _ = asyncio.run(fresh_namespaces())
        command = [sys.executable, "-m", "application_manager.commands.cli", "run", "--namespace", namespace]
        process = subprocess.Popen([*command, "--ttl-after-finished", "1s", "--resync", "10s"], stdout=log, stderr=log)
        try:
            return asyncio.run(_serve(plane, process, namespace, tasks))
        finally:
            process.terminate()
            process.wait()


async def _serve(plane: ControlPlane, process: subprocess.Popen[bytes], namespace: str, count: int) -> dict[str, float]:
    client, seen, api = manager_client(await load_configuration()), DeploymentWatch(), plane.api(namespace)
    spec = json.loads(json.dumps(TEMPLATE["spec"]))
    spec["manifests"][0]["spec"]["replicas"] = 1
    await client.create(TEMPLATES, {**TEMPLATE, "metadata": {"name": "app", "namespace": namespace}, "spec": spec})
    try:
        async with seen.watching(client, namespace):
            await client.create(TASKS, task(namespace, "warm"))
            await seen.wait(1)
            await asyncio.sleep(5.0)
            writes, memory = _writes(api), resident(process.pid, "VmRSS")
            others = _cluster_cpu(plane)
            idle = await _spent(process, 5.0)
            began, before = time.monotonic(), cpu_seconds(process.pid)
            names = [f"t{number}" for number in range(count)]
            await at_once([client.create(TASKS, task(namespace, name)) for name in names])
            await seen.wait(count + 1)
        await _wait(lambda: all(it.get("status", {}).get("phase") for it in api.list("ApplicationTask")))
        await asyncio.sleep(3.0)
        start = cpu_seconds(process.pid) - before - idle * (time.monotonic() - began)
        grown, size = resident(process.pid, "VmRSS") - memory, _bytes(api)
        began, before = time.monotonic(), cpu_seconds(process.pid)
        end = datetime.now(UTC).isoformat().replace("+00:00", "Z")
        for name in names:
            api.patch("ApplicationTask", name, {"spec": {"endTime": end}})
        await _wait(lambda: len(api.list("ApplicationTask")) <= 1 and len(api.list("Pod")) <= 1)
        end_cpu = cpu_seconds(process.pid) - before - idle * (time.monotonic() - began)
    finally:
        await client.close()
    return {
        "manager_start": start / count,
        "manager_end": end_cpu / count,
        "cluster_task": (_cluster_cpu(plane) - others) / count,
        "writes": (_writes(api) - writes) / count,
        "task_bytes": size / (count + 1),
        "manager_bytes": memory * 2**20,
        "manager_task_bytes": grown * 2**20 / count,
    }


async def _spent(process: subprocess.Popen[bytes], seconds: float) -> float:
    before = cpu_seconds(process.pid)
    await asyncio.sleep(seconds)
    return (cpu_seconds(process.pid) - before) / seconds


async def _wait(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not true():  # noqa: ASYNC110  the cluster sets no event
            await asyncio.sleep(1.0)


def _cluster_cpu(plane: ControlPlane) -> float:
    return sum(cpu_seconds(pid) for pid in plane.pids())


def _writes(api: Api) -> float:
    """How many changing requests the API server has answered."""
    return sum(
        float(line.rpartition(" ")[2])
        for line in api.raw("/metrics").splitlines()
        if line.startswith("apiserver_request_total{")
        and any(f'verb="{verb}"' in line for verb in ("POST", "PUT", "PATCH", "APPLY", "DELETE"))
    )


def _bytes(api: Api) -> int:
    kinds = ("ApplicationTask", "ApplicationInstance", "Deployment", "ReplicaSet", "Pod", "Event")
    return sum(len(json.dumps(each, separators=(",", ":"))) for kind in kinds for each in api.list(kind))
