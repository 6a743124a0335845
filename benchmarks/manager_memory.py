"""The manager's memory with tasks of about 1 MB each, beside that with as many small ones, in the same run.

One manager after the other lists and serves the tasks of a namespace of its own. Prints the resident set of each before
there are tasks, at its largest and at the end. Exits with 1 where the large tasks take more than their target.

    python -m benchmarks.manager_memory [--tasks 40] [--bytes 1000000]

Uses the cluster of KUBECONFIG where that is set, else a control plane of its own.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from application_manager.cluster.client import manager_client
from benchmarks.task_to_deployment import TASKS, TEMPLATE, TEMPLATES, fresh_namespaces, task
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import load_configuration

TARGET = 300  # MiB that the large tasks may take more than the small ones, at the largest; 40 of them are 40 MB
SETTLED = 8.0  # s after the last status: two resyncs
PATIENCE = 120.0  # s
_ITEMS = 4000  # of one value, each 9 bytes as JSON and 64 in Python; the API server takes no more than 4,096


def large(namespace: str, number: int, size: int) -> dict[str, Any]:
    """A task with `size` bytes of free data, in an instance of its own."""
    made = task(namespace, f"t{number}")
    values = {f"x{index}": [f"v{item:05}" for item in range(_ITEMS)] for index in range(size // (9 * _ITEMS))}
    time = "2026-01-01T00:00:00Z"
    event = {"id": f"e{number}", "rule": "r", "action": "a", "subject": "s", "onsetTime": time, "startTime": time}
    return {**made, "spec": {**made["spec"], "event": {**event, "values": values}}}


def resident(pid: int, field: str) -> float:
    """MiB of a process, by a field of its status: VmRSS now, VmHWM at its largest."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition(f"{field}:")[2].split()[0]) / 1024


async def fill(manager: subprocess.Popen[bytes], namespace: str, count: int, size: int) -> tuple[float, float, float]:
    """Make the tasks and wait until all have a status; MiB before, at the largest and at the end."""
    client = manager_client(await load_configuration())
    try:
        await client.create(TEMPLATES, {**TEMPLATE, "metadata": {"name": "app", "namespace": namespace}})
        await client.create(TASKS, task(namespace, "first"))
        await _all_reported(client, namespace)
        before = resident(manager.pid, "VmRSS")
        for number in range(count):
            await client.create(TASKS, large(namespace, number, size))
        await _all_reported(client, namespace)
        await asyncio.sleep(SETTLED)
        return before, resident(manager.pid, "VmHWM"), resident(manager.pid, "VmRSS")
    finally:
        await client.close()


async def _all_reported(client: Client, namespace: str) -> None:
    async with asyncio.timeout(PATIENCE):
        while True:
            reported = [
                "phase" in raw.get("status", {}) async for page, _ in client.pages(TASKS, namespace) for raw in page
            ]
            if all(reported):
                return
            await asyncio.sleep(0.5)


def measure(namespace: str, count: int, size: int) -> tuple[float, float, float]:
    """The memory of a manager of the namespace."""
    command = [
        sys.executable,
        "-m",
        "application_manager.commands.cli",
        "run",
        "--namespace",
        namespace,
        "--resync",
        "3s",
    ]
    with tempfile.TemporaryFile() as log:
        manager = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            return asyncio.run(fill(manager, namespace, count, size))
        finally:
            manager.terminate()
            manager.wait()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--tasks", type=int, default=40)
    parser.add_argument("--bytes", type=int, default=1_000_000, help="of each large task")
    options = parser.parse_args()
    given = "KUBECONFIG" in os.environ
    with nullcontext() if given else ControlPlane(crds=CRDS) as plane:
        if plane is not None:
            os.environ["KUBECONFIG"] = str(plane.kubeconfig)
        namespaces = asyncio.run(fresh_namespaces())
        found = {}
        for name, namespace, size in (("small", namespaces[0], 0), ("large", namespaces[1], options.bytes)):
            found[name] = measure(namespace, options.tasks, size)
            before, most, end = found[name]
            print(f"{options.tasks} {name} tasks: before {before:5.0f} MiB, at most {most:5.0f}, at the end {end:5.0f}")
    more = found["large"][1] - found["small"][1]
    print(f"ratio of the largest {found['large'][1] / found['small'][1]:.2f}; {more:.0f} MiB more, target {TARGET}")
    sys.exit(0 if more <= TARGET else 1)


if __name__ == "__main__":
    main()
