"""A task of one namespace, alone and while another namespace attacks the manager: the times, and the manager's memory.

The attack, all from one namespace (see `attacker`): templates whose expressions take too long, whose values change all
the time; a flood of tasks; and large tasks. Prints the times from a task to its Deployment and to its status, alone and
under attack, beside those of its creation alone and of three raw calls; where requests waited; what each program used;
and the manager's largest resident set. Exits with 1 where a target is missed.

With `--unserved`, the attack comes from a namespace that the manager does not serve: the API server and the machine
alone make the other tasks slower then.

    python -m benchmarks.attacks.load [--tasks 30] [--bombs 8] [--flood 10000] [--large 40] [--unserved]

Everybody has an account of its own and the rights that the chart gives: an administrator goes past API Priority and
Fairness. The control plane is its own, and shares the machine's cores with all else here, so the machine must be idle.
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
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from application_manager.cluster.client import manager_client
from application_manager.core.claims.claims import instance_name
from benchmarks.attacks.cluster import LOUD, QUIET, SYSTEM, UNSERVED, Cluster, small_cluster
from benchmarks.task_to_deployment import PATIENCE, TASKS, TEMPLATE, DeploymentWatch, cpu_seconds, task
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import load_configuration
from wayside.kubernetes.resources import Resource

CONFIG_MAPS = Resource("v1", "ConfigMap", "configmaps")
SLOWER = 2.0  # times that a task may take under attack, 95th percentile
STATUS = 5.0  # s to its status, 95th percentile
MEMORY = 1024  # MiB: the chart's limit
PAUSE = 0.3  # s between two tasks that are measured
WARMING = 10  # tasks before those that are measured
GATHERING = 5.0  # s from the start of the attack to the first task that is measured
LONGEST = 420.0  # s of an attack
_LOOK = 0.02  # s between two looks for a status

STAGES = ("creation", "Deployment", "status", "raw calls")


class Measured:
    """Seconds from the creation of tasks to their Deployments, and to their statuses."""

    def __init__(self, client: Client, seen: DeploymentWatch) -> None:
        self._client = client
        self._seen = seen

    async def times(self, prefix: str, more: Callable[[int], bool]) -> dict[str, list[float]]:
        """The times of each of STAGES, task by task while `more` returns true, with raw calls in between."""
        found: dict[str, list[float]] = {stage: [] for stage in STAGES}
        index = -1
        while more(index := index + 1):
            name = f"{prefix}{index}"
            began = time.perf_counter()
            await self._client.create(TASKS, task(QUIET, name))
            found["creation"].append(time.perf_counter() - began)
            status = asyncio.create_task(self._status(name))
            await self._seen.wait(len(self._seen.at) + (instance_name("app", name) not in self._seen.at))
            found["Deployment"].append(self._seen.at[instance_name("app", name)] - began)
            found["status"].append(await status - began)
            await asyncio.sleep(PAUSE)
            found["raw calls"].append(await self._raw(name))
            await asyncio.sleep(PAUSE)
        return found

    async def _raw(self, name: str) -> float:
        """Seconds of three calls that make an object each, which no manager looks at: what the API server takes."""
        began = time.perf_counter()
        for index in range(3):
            metadata = {"name": f"{name}-{index}", "namespace": QUIET}
            await self._client.create(CONFIG_MAPS, {"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata})
        return time.perf_counter() - began

    async def _status(self, name: str) -> float:
        async with asyncio.timeout(PATIENCE):
            while "status" not in (  # noqa: ASYNC110  what is waited for is at the API server
                await self._client.get(TASKS, QUIET, name) or {}
            ):
                await asyncio.sleep(_LOOK)
        return time.perf_counter()


class Usage:
    """The CPU share of each program, and the queues of requests, from its creation to `report`.

    The rest of the machine's CPU time belongs to other programs: if it is large, the times mean little.
    """

    def __init__(self, cluster: Cluster, programs: Mapping[str, int]) -> None:
        self._cluster = cluster
        self._programs = {**programs, "benchmark": os.getpid()}
        self._began = time.monotonic()
        self._requests = cluster.requests()
        self._cpu = self._seconds()

    def _seconds(self) -> dict[str, float]:
        """CPU seconds of the manager without and with its workers, of the others, and of the whole machine."""
        used = {name: cpu_seconds(pid) for name, pid in self._programs.items()}
        used["workers"] = _of_children(self._programs["manager"])
        ticks = list(map(int, Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]))
        idle = ticks[3] + ticks[4]
        return {**used, "strangers": (sum(ticks[:8]) - idle) / os.sysconf("SC_CLK_TCK") - sum(used.values())}

    def report(self, when: str) -> None:
        """Print both."""
        elapsed = time.monotonic() - self._began
        used = {name: (now - self._cpu[name]) / elapsed for name, now in self._seconds().items()}
        print(f"{when}: cores used by " + ", ".join(f"{name} {each:.2f}" for name, each in used.items()))
        for schema, now in self._cluster.requests().items():
            before = self._requests.get(schema, (0.0, 0.0, 0.0))
            count, wait, execution = (after - was for after, was in zip(now, before, strict=True))
            if count > elapsed:
                rate = f"{count / elapsed:6.1f} requests/s"
                means = f"{wait / count * 1e3:6.1f} ms in a queue, {execution / count * 1e3:6.1f} ms at work"
                print(f"{when}: {schema:24} {rate}, in the mean {means}")


def _of_children(pid: int) -> float:
    """The CPU seconds of a process's children: of those that have ended, and of those that run."""
    ended = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()[13:15]
    running = 0.0
    for thread in Path(f"/proc/{pid}/task").iterdir():
        for child in (thread / "children").read_text().split():
            with suppress(OSError):  # it has ended meanwhile
                running += cpu_seconds(int(child))
    return sum(map(int, ended)) / os.sysconf("SC_CLK_TCK") + running


def _p95(values: list[float]) -> float:
    return statistics.quantiles(values, n=20)[18]


def largest(pid: int) -> float:
    """MiB of the largest resident set that a process has had."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("VmHWM:")[2].split()[0]) / 1024


async def measure(options: argparse.Namespace, cluster: Cluster, manager: int) -> list[str]:
    """Measure and print; what was missed."""
    os.environ["KUBECONFIG"] = str(cluster.tenants[QUIET])
    client, seen = manager_client(await load_configuration()), DeploymentWatch()
    measured = Measured(client, seen)
    programs = {**cluster.programs, "manager": manager}
    attacker: subprocess.Popen[bytes] | None = None
    try:
        async with seen.watching(client, QUIET):
            await measured.times("warm", lambda done: done < WARMING)
            usage = Usage(cluster, programs)
            alone = await measured.times("alone", lambda done: done < options.tasks)
            usage.report("alone")
            attacker = attack(options, cluster)
            await asyncio.sleep(GATHERING)
            usage = Usage(cluster, programs)
            until = time.monotonic() + LONGEST
            attacked = await measured.times("attacked", lambda _: attacker.poll() is None and time.monotonic() < until)
            usage.report("under attack")
            whole = attacker.poll() == 0
    finally:
        if attacker is not None:
            attacker.kill()
            attacker.wait()
        await client.close()
    memory = largest(manager)
    print(f"measured: {options.tasks} tasks alone, and {len(attacked['status'])} while the attack lasted")
    for stage in STAGES:
        for what, of in (("p50", statistics.median), ("p95", _p95)):
            before, after = of(alone[stage]), of(attacked[stage])
            times = f"alone {before * 1e3:7.1f} ms   under attack {after * 1e3:7.1f} ms"
            print(f"{stage:10} {what}  {times}   {after / before:.2f} times")
    print(f"the manager's memory     {memory:.0f} MiB at most, of {MEMORY}")
    print(f"targets: the Deployment within {SLOWER:g} times, the status within {STATUS:g} s, both p95")
    found = {
        "the time": _p95(attacked["Deployment"]) > SLOWER * _p95(alone["Deployment"]),
        "the status": _p95(attacked["status"]) > STATUS,
        "the memory": memory > MEMORY,
        f"a whole attack within {LONGEST:.0f} s: give a smaller --flood": not whole,
        "enough tasks under attack: give a larger --flood": len(attacked["status"]) < options.tasks,
    }
    return [what for what, missed in found.items() if missed]


def attack(options: argparse.Namespace, cluster: Cluster) -> subprocess.Popen[bytes]:
    """Start the attacks."""
    given = [f"--{name}={getattr(options, name)}" for name in ("bombs", "flood", "large")]
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.attacks.attacker", options.attacker, *given],
        env=os.environ | {"KUBECONFIG": str(cluster.tenants[options.attacker])},
    )


def main() -> None:
    """Run the attacks."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name, default in (("tasks", 30), ("bombs", 8), ("flood", 10_000), ("large", 40)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--unserved", dest="attacker", action="store_const", const=UNSERVED, default=LOUD)
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        small_cluster(Path(folder)) as cluster,
        tempfile.TemporaryFile() as log,
    ):
        for namespace in (QUIET, options.attacker):
            cluster.api.create({**TEMPLATE, "metadata": {"name": "app", "namespace": namespace}})
        manager = subprocess.Popen(
            [sys.executable, "-m", "application_manager.commands.cli", "run", f"--lease={SYSTEM}/application-manager"],
            env=os.environ | {"KUBECONFIG": str(cluster.manager)},
            stdout=log,
            stderr=log,
        )
        try:
            missed = asyncio.run(measure(options, cluster, manager.pid))
        finally:
            manager.terminate()
            manager.wait()
    sys.exit(f"missed: {', '.join(missed)}" if missed else 0)


if __name__ == "__main__":
    main()
