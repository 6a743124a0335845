"""A task of one namespace, alone and while another namespace attacks the manager: the times, and the manager's memory.

The attack, all from one namespace: templates whose expressions take too long, whose values change all the time; a flood
of tasks; and large tasks. Prints the 95th percentile from a task to its Deployment and to its status, alone and under
attack, beside that of three raw calls, which the API server alone makes slower; and the manager's largest resident set.
Exits with 1 where one of the targets is missed.

    python -m benchmarks.attacks.load [--tasks 30] [--bombs 8] [--flood 10000] [--large 40]

Uses the cluster of KUBECONFIG where that is set, else a control plane of its own.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from application_manager.cluster.client import Client, Resource
from application_manager.cluster.connection import load_configuration
from application_manager.core.claims.claims import instance_name
from benchmarks.manager_memory import large as small
from benchmarks.task_to_deployment import (
    PATIENCE,
    TASKS,
    TEMPLATE,
    TEMPLATES,
    Seen,
    at_once,
    fresh_namespaces,
    task,
)
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from tests.worker_jobs import TEXT

CONFIG_MAPS = Resource("v1", "ConfigMap", "configmaps")
SLOWER = 2.0  # times that a task may take under attack, 95th percentile
STATUS = 5.0  # s to its status, 95th percentile
MEMORY = 1024  # MiB: the chart's limit
LARGE = 1_000_000  # bytes of a large task
TEXT_LENGTH = 60_000  # of each of its values: the API server takes no more than 65,536
PAUSE = 0.3  # s between two tasks that are measured
_LOOK = 0.02  # s between two looks for a status


def bomb(namespace: str, number: int) -> dict[str, Any]:
    """A template that takes half a minute to render with the values of `bombing`."""
    expression = 'parameters.l.filter(x, parameters.s.matches("([ab]*a[ab]{50}){3}z")).size()'
    config = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "${instance.name}"}}
    return {
        **TEMPLATE,
        "metadata": {"name": f"bomb{number}", "namespace": namespace},
        "spec": {
            "parameters": {"l": {"type": "array", "items": "string"}, "s": {"type": "string"}},
            "manifests": [{**config, "data": {"n": f"n=${{{expression}}}"}}],
        },
    }


async def bombing(client: Client, namespace: str, number: int) -> None:
    """Give a bomb other values again and again, until cancelled."""
    turn = 0
    while True:
        turn += 1
        items = [f"{turn}-{index}" for index in range(2000)]
        spec = {"template": f"bomb{number}", "parameters": {"l": items, "s": TEXT}}
        made = {**task(namespace, f"bomb{number}-{turn}"), "spec": spec}
        raw = await client.create(TASKS, made)
        await asyncio.sleep(2.0)
        await client.delete(TASKS, namespace, made["metadata"]["name"], raw["metadata"]["uid"])


def large(namespace: str, number: int) -> dict[str, Any]:
    """A task with about a megabyte of text."""
    made = small(namespace, number, 0)
    values = {f"x{index}": "x" * TEXT_LENGTH for index in range(LARGE // TEXT_LENGTH)}
    return {**made, "spec": {**made["spec"], "event": {**made["spec"]["event"], "values": values}}}


class Measured:
    """Seconds from the creation of tasks to their Deployments, and to their statuses."""

    def __init__(self, client: Client, namespace: str, seen: Seen) -> None:
        self._client = client
        self._namespace = namespace
        self._seen = seen

    async def p95(self, prefix: str, count: int) -> tuple[float, float, float]:
        """The 95th percentiles of both, over as many tasks, one after the other; and of three raw calls in between."""
        deployed: list[float] = []
        told: list[float] = []
        raw: list[float] = []
        for index in range(count):
            name = f"{prefix}{index}"
            began = time.perf_counter()
            await self._client.create(TASKS, task(self._namespace, name))
            status = asyncio.create_task(self._status(name))
            await self._seen.wait(len(self._seen.at) + (instance_name("app", name) not in self._seen.at))
            deployed.append(self._seen.at[instance_name("app", name)] - began)
            told.append(await status - began)
            await asyncio.sleep(PAUSE)
            raw.append(await self._raw(name))
            await asyncio.sleep(PAUSE)
        return _p95(deployed), _p95(told), _p95(raw)

    async def _raw(self, name: str) -> float:
        """Seconds of three calls that make an object each, which no manager looks at: what the API server takes."""
        began = time.perf_counter()
        for index in range(3):
            metadata = {"name": f"{name}-{index}", "namespace": self._namespace}
            await self._client.create(CONFIG_MAPS, {"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata})
        return time.perf_counter() - began

    async def _status(self, name: str) -> float:
        async with asyncio.timeout(PATIENCE):
            while "status" not in (  # noqa: ASYNC110  what is waited for is at the API server
                await self._client.get(TASKS, self._namespace, name) or {}
            ):
                await asyncio.sleep(_LOOK)
        return time.perf_counter()


def _p95(values: list[float]) -> float:
    return statistics.quantiles(values, n=20)[18]


def largest(pid: int) -> float:
    """MiB of the largest resident set that a process has had."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("VmHWM:")[2].split()[0]) / 1024


async def measure(options: argparse.Namespace, pid: int, namespaces: tuple[str, str]) -> list[str]:
    """Measure and print; what was missed."""
    quiet, loud = namespaces
    client, attacker, seen = Client(await load_configuration()), Client(await load_configuration()), Seen()
    for namespace in namespaces:
        await client.create(TEMPLATES, {**TEMPLATE, "metadata": {"name": "app", "namespace": namespace}})
    attacks: list[asyncio.Task[None]] = []
    measured = Measured(client, quiet, seen)
    try:
        async with seen.watching(client, quiet):
            await measured.p95("warm", 5)
            alone, status_alone, raw_alone = await measured.p95("alone", options.tasks)
            for number in range(options.bombs):
                await attacker.create(TEMPLATES, bomb(loud, number))
                attacks.append(asyncio.create_task(bombing(attacker, loud, number)))
            flood = [attacker.create(TASKS, task(loud, f"flood{index}")) for index in range(options.flood)]
            flood += [attacker.create(TASKS, large(loud, index)) for index in range(options.large)]
            attacks.append(asyncio.create_task(at_once(flood)))
            attacked, status, raw = await measured.p95("attacked", options.tasks)
    finally:
        for attack in attacks:
            attack.cancel()
        await asyncio.gather(*attacks, return_exceptions=True)
        await client.close()
        await attacker.close()
    memory = largest(pid)
    for what, before, after in (
        ("Deployment", alone, attacked),
        ("status", status_alone, status),
        ("raw calls", raw_alone, raw),
    ):
        times = f"alone {before * 1e3:7.1f} ms   under attack {after * 1e3:7.1f} ms"
        print(f"{what:10}, p95  {times}   {after / before:.2f} times")
    print(f"targets: the Deployment within {SLOWER:g} times, the status within {STATUS:g} s")
    print(f"the manager's memory     {memory:.0f} MiB at most, of {MEMORY}")
    found = {"the time": attacked > SLOWER * alone, "the status": status > STATUS, "the memory": memory > MEMORY}
    return [what for what, missed in found.items() if missed]


def main() -> None:
    """Run the attacks."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name, default in (("tasks", 30), ("bombs", 8), ("flood", 10_000), ("large", 40)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    given = "KUBECONFIG" in os.environ
    with nullcontext() if given else ControlPlane(crds=CRDS) as plane, tempfile.TemporaryFile() as log:
        if plane is not None:
            os.environ["KUBECONFIG"] = str(plane.kubeconfig)
        namespaces = asyncio.run(fresh_namespaces())
        command = [sys.executable, "-m", "application_manager.cli", "run"]
        for namespace in namespaces:
            command += ["--namespace", namespace]
        manager = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            missed = asyncio.run(measure(options, manager.pid, namespaces))
        finally:
            manager.terminate()
            manager.wait()
    sys.exit(f"missed: {', '.join(missed)}" if missed else 0)


if __name__ == "__main__":
    main()
