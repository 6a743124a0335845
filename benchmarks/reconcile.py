"""The CPU time of one reconcile of an instance, compared with an older revision.

The manager's parts are wired as in the cluster, over an API server in memory. Each case makes the instances of as many
tasks, and then reconciles each of them again and again, with nothing left to do: that is what most reconciles are. The
older revision runs the same script from `git archive`. Rounds alternate; each figure is the least of its rounds.

    python -m benchmarks.reconcile [--against HEAD] [--instances 200] [--rounds 5]
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from application_manager.core.claims.claims import instance_name
from application_manager.measures import Measures
from application_manager.running.assembly import Assembly
from application_manager.running.options import Options
from benchmarks.task_to_deployment import DEPLOYMENTS, INSTANCES, TASKS, TEMPLATE, TEMPLATES, task
from tests.unit.manager.memory_server import MemoryServer
from wayside.api import API_VERSION
from wayside.kubernetes.client import Client
from wayside.kubernetes.resources import Resource

NAMESPACE = "site"
PARTS = ("application_manager", "benchmarks", "tests", "wayside")
CASES: dict[str, dict[str, Any]] = {
    "without limits": {},
    "with a limit": {"maxInstances": 100_000},
    "with a fallback": {"lifecycle": {"readyTimeout": "60s", "fallback": {"templateName": "lite"}}},
}
REPEATS = 5  # reconciles of each instance in a round


class Server(MemoryServer):
    """An API server in memory that also takes Events."""

    async def create(self, resource: Resource, manifest: dict[str, Any]) -> dict[str, Any]:
        """Take an Event, which nobody reads."""
        return manifest


def assembly(server: Server, spec: dict[str, Any]) -> Assembly:
    """The manager's parts over the server, which has a template."""
    rules = {(API_VERSION, kind): Resource(API_VERSION, kind, f"{kind.lower()}s") for kind in ("EventRule", "Detector")}
    own = {(each.api_version, each.kind): each for each in (TEMPLATES, TASKS, INSTANCES, DEPLOYMENTS)}
    made = Assembly(cast("Client", server), Options(), {**own, **rules}, Measures(), None)
    for name, more in (("app", spec), ("lite", {})):
        metadata = {"name": name, "namespace": NAMESPACE, "uid": name, "generation": 1}
        made.router.observe(server.put({**TEMPLATE, "metadata": metadata, "spec": {**TEMPLATE["spec"], **more}}))
    return made


async def seconds(spec: dict[str, Any], instances: int) -> float:
    """CPU seconds of one reconcile that finds nothing to do."""
    server = Server()
    made = assembly(server, spec)
    work: Callable[[Any], Any] = made.queues[0]._work  # without the queue, whose timers are not to be measured
    names = [(NAMESPACE, instance_name("app", f"r{index}")) for index in range(instances)]
    for index in range(instances):
        raw = task(NAMESPACE, f"r{index}")
        made.router.observe(server.put({**raw, "metadata": {**raw["metadata"], "generation": 1}}))
    for name in names:
        await work(name)
    assert sum(kind == "Deployment" for kind, _ in server.objects) == instances
    written, began = len(server.written), time.process_time()
    for _ in range(REPEATS):
        for name in names:
            await work(name)
    took = time.process_time() - began
    assert len(server.written) == written
    await made.close()
    return took / (REPEATS * instances)


def measured(tree: Path, instances: int) -> dict[str, float]:
    """CPU seconds of a reconcile in each case, by the code of that tree."""
    command = [sys.executable, str(Path(__file__).resolve()), "--measure", "--instances", str(instances)]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    found = subprocess.run(command, env=environment, cwd=tree, check=True, capture_output=True)
    return cast("dict[str, float]", json.loads(found.stdout))


def main() -> None:
    """Measure, and print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--against", default="HEAD", help="the older revision (%(default)s)")
    parser.add_argument("--instances", type=int, default=200, help="how many instances there are (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="of each revision (%(default)s)")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps({name: asyncio.run(seconds(spec, options.instances)) for name, spec in CASES.items()}))
        return
    root = Path(__file__).parents[1]
    with tempfile.TemporaryDirectory() as folder:
        command = ["git", "-C", str(root), "archive", options.against, *PARTS]
        archive = subprocess.run(command, check=True, capture_output=True).stdout
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            files.extractall(folder, filter="data")
        before, now = [], []
        for _ in range(options.rounds):
            before.append(measured(Path(folder), options.instances))
            now.append(measured(root, options.instances))
    for case in CASES:
        old, new = min(each[case] for each in before), min(each[case] for each in now)
        print(f"{case:16} {old * 1e6:7.0f} µs at {options.against}   {new * 1e6:7.0f} µs now   ratio {new / old:.2f}")


if __name__ == "__main__":
    main()
