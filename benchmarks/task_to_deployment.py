"""Task created → Deployment exists, beside the raw API calls alone, in the same run.

Sequential: one task after the other, alternated with the raw calls: create the task, apply the instance, apply the
Deployment, by the same client library, in a namespace that no manager looks at. Burst: many tasks at once, beside as
many raw series at once, each twice and each first once. A watch reports the managed Deployments. Exits
with 1 where the sequential ratio misses its target.

    python -m benchmarks.task_to_deployment [--sequential 60] [--burst 1000]

Uses the cluster of KUBECONFIG where that is set, else a control plane of its own.
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
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path
from typing import Any

import aiohttp

from application_manager.cluster.client import manager_client
from application_manager.core.claims.claims import instance_name
from application_manager.core.objects.ownership import owned
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from wayside.api import API_VERSION, ApplicationInstance, ApplicationTemplate
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import load_configuration
from wayside.kubernetes.resources import Resource

TASKS = Resource(API_VERSION, "ApplicationTask", "applicationtasks")
INSTANCES = Resource(API_VERSION, "ApplicationInstance", "applicationinstances")
TEMPLATES = Resource(API_VERSION, "ApplicationTemplate", "applicationtemplates")
DEPLOYMENTS = Resource("apps/v1", "Deployment", "deployments")
NAMESPACES = Resource("v1", "Namespace", "namespaces", namespaced=False)
AT_ONCE = 16
BURSTS = 2  # of each kind; either kind begins as often as the other
TARGET = 1.3  # the most that a task may take in the middle, as a multiple of the raw calls
PATIENCE = 300.0  # s
SETTLING = 0.5  # s after each, so that neither is measured amid what the other has set off: ReplicaSets, statuses

TEMPLATE: dict[str, Any] = {
    "apiVersion": API_VERSION,
    "kind": "ApplicationTemplate",
    "metadata": {"name": "app"},
    "spec": {
        "parameters": {"region": {"type": "string", "required": True}},
        "key": "${parameters.region}",
        "lifecycle": {"linger": "0s"},
        "manifests": [
            {
                "apiVersion": "apps/v1",
                "kind": "Deployment",
                "metadata": {"name": "${instance.name}"},
                "spec": {
                    "replicas": 0,
                    "selector": {"matchLabels": {"app": "${instance.name}"}},
                    "template": {
                        "metadata": {"labels": {"app": "${instance.name}"}},
                        "spec": {"containers": [{"name": "main", "image": "registry.example/app:1"}]},
                    },
                },
            }
        ],
    },
}


def task(namespace: str, region: str) -> dict[str, Any]:
    """A task that wants an instance of its own."""
    return {
        "apiVersion": API_VERSION,
        "kind": "ApplicationTask",
        "metadata": {"name": region, "namespace": namespace},
        "spec": {"templateName": "app", "parameters": {"region": region}},
    }


class RawCalls:
    """The three calls, as a program would make them that knows everything beforehand."""

    def __init__(self, client: Client, namespace: str) -> None:
        self.client = client
        self.namespace = namespace
        metadata = {"name": "app", "namespace": namespace}
        self.renderer = Renderer(ApplicationTemplate.model_validate({**TEMPLATE, "metadata": metadata}), Policy())

    async def series(self, region: str) -> float:
        """Seconds from the start of the first call to the end of the last."""
        began = time.perf_counter()
        await self.client.create(TASKS, task(self.namespace, region))
        raw = await self.client.apply(INSTANCES, self.instance(region))
        model = ApplicationInstance.model_validate(raw)
        await self.client.apply(DEPLOYMENTS, owned(self.renderer.render(model).manifests[0], model))
        return time.perf_counter() - began

    def instance(self, region: str) -> dict[str, Any]:
        """The instance for a region."""
        return {
            "apiVersion": API_VERSION,
            "kind": "ApplicationInstance",
            "metadata": {"name": instance_name("app", region), "namespace": self.namespace},
            "spec": {"templateName": "app", "key": region, "parameters": {"region": region}},
        }


class DeploymentWatch:
    """When each Deployment of a namespace came up, by a watch."""

    def __init__(self) -> None:
        self.at: dict[str, float] = {}
        self._changed = asyncio.Condition()

    @asynccontextmanager
    async def watching(self, client: Client, namespace: str) -> AsyncIterator[None]:
        """Watch meanwhile."""
        started = asyncio.Event()
        watch = asyncio.create_task(self._watch(client, namespace, started))
        await started.wait()
        try:
            yield
        finally:
            watch.cancel()
            await asyncio.gather(watch, return_exceptions=True)

    async def _watch(self, client: Client, namespace: str, started: asyncio.Event) -> None:
        configuration = client.configuration
        token = await configuration.get_api_key_with_prefix("BearerToken", alias="authorization")
        url = f"{configuration.host}{DEPLOYMENTS.path(namespace)}?watch=true"
        response = await client._api.rest_client.request(  # the manager's own verbs have no watch: kopf does that
            "GET", url, headers={"Authorization": token or ""}, _request_timeout=aiohttp.ClientTimeout(total=None)
        )
        started.set()
        async for line in response.response.content:
            event = json.loads(line)
            if event["type"] == "ADDED":
                self.at[event["object"]["metadata"]["name"]] = time.perf_counter()
                async with self._changed:
                    self._changed.notify_all()

    async def wait(self, count: int) -> None:
        """Wait until this number was seen."""
        async with self._changed, asyncio.timeout(PATIENCE):
            await self._changed.wait_for(lambda: len(self.at) >= count)


async def at_once(series: list[Any]) -> None:
    """Run the coroutines, AT_ONCE of them at a time."""
    gate = asyncio.Semaphore(AT_ONCE)

    async def one(each: Any) -> None:
        async with gate:
            await each

    await asyncio.gather(*(one(each) for each in series))


def cpu_seconds(pid: int) -> float:
    """The CPU time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def measure(sequential: int, burst: int, manager: subprocess.Popen[bytes], namespaces: tuple[str, str]) -> float:
    """Measure and print; the sequential ratio of p50."""
    ours, theirs = namespaces
    client = manager_client(await load_configuration())
    raw, seen = RawCalls(client, theirs), DeploymentWatch()
    await client.create(TEMPLATES, {**TEMPLATE, "metadata": {"name": "app", "namespace": ours}})
    async with seen.watching(client, ours):
        for index in range(5):  # warm up both
            await client.create(TASKS, task(ours, f"warm{index}"))
            await seen.wait(index + 1)
            await raw.series(f"warm{index}")
        took: list[float] = []
        alone: list[float] = []
        for index in range(sequential):
            alone.append(await raw.series(f"s{index}"))
            await asyncio.sleep(SETTLING)
            began = time.perf_counter()
            await client.create(TASKS, task(ours, f"s{index}"))
            await seen.wait(6 + index)
            took.append(seen.at[instance_name("app", f"s{index}")] - began)
            await asyncio.sleep(SETTLING)
        for name, values in (("task → Deployment", took), ("raw calls alone", alone)):
            cuts = statistics.quantiles(values, n=20)
            print(f"sequential  {name:18} p50 {cuts[9] * 1e3:6.1f} ms   p95 {cuts[18] * 1e3:6.1f} ms")
        ratio = statistics.median(took) / statistics.median(alone)
        verdict = "met" if ratio <= TARGET else "missed"
        print(f"sequential  ratio of p50       {ratio:.2f} (target: at most {TARGET}, {verdict})")

        alone_took = took_all = cpu = 0.0
        for turn in range(BURSTS):
            regions = [f"b{turn}-{index}" for index in range(burst)]
            for managed in (turn % 2 == 0, turn % 2 == 1):
                if managed:
                    before = cpu_seconds(manager.pid)
                    elapsed = await managed_burst(client, seen, ours, regions)
                    took_all, cpu = took_all + elapsed, cpu + cpu_seconds(manager.pid) - before
                else:
                    began = time.perf_counter()
                    await at_once([raw.series(region) for region in regions])
                    alone_took += time.perf_counter() - began
                await asyncio.sleep(SETTLING)
        count, what = burst * BURSTS, f"{BURSTS} bursts of {burst}"
        used = f"the manager used {cpu / took_all:.0%} of one core"
        print(f"{what}  task → Deployment  {count / took_all:6.1f} /s, {used}")
        print(f"{what}  raw calls alone    {count / alone_took:6.1f} /s")
        print(f"{what}  ratio of times     {took_all / alone_took:.2f}")
    await client.close()
    return ratio


async def managed_burst(client: Client, seen: DeploymentWatch, namespace: str, regions: list[str]) -> float:
    """Seconds from the creation of the first task until all Deployments were seen."""
    count, began = len(seen.at), time.perf_counter()
    creating = asyncio.create_task(at_once([client.create(TASKS, task(namespace, region)) for region in regions]))
    await seen.wait(count + len(regions))
    await creating
    return time.perf_counter() - began


async def fresh_namespaces() -> tuple[str, str]:
    """Two new namespaces: the manager's, and that of the raw calls."""
    client = manager_client(await load_configuration())
    stamp = f"{time.time_ns():x}"
    names = (f"bench-managed-{stamp}", f"bench-raw-{stamp}")
    for name in names:
        await client.create(
            NAMESPACES, {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name, "namespace": ""}}
        )
    await client.close()
    return names


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sequential", type=int, default=60, help="tasks one after the other")
    parser.add_argument("--burst", type=int, default=1000, help="tasks at once")
    options = parser.parse_args()
    given = "KUBECONFIG" in os.environ
    with nullcontext() if given else ControlPlane(crds=CRDS) as plane, tempfile.TemporaryFile() as log:
        if plane is not None:
            os.environ["KUBECONFIG"] = str(plane.kubeconfig)
        namespaces = asyncio.run(fresh_namespaces())
        command = [sys.executable, "-m", "application_manager.commands.cli", "run", "--namespace", namespaces[0]]
        manager = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            ratio = asyncio.run(measure(options.sequential, options.burst, manager, namespaces))
        finally:
            manager.terminate()
            manager.wait()
    sys.exit(0 if ratio <= TARGET else 1)


if __name__ == "__main__":
    main()
