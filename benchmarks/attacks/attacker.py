"""The attacks of `load`, all from one namespace and by one account, until the last task of the flood is made.

Templates whose expressions take too long, whose values change all the time; a flood of tasks, as many at once as one
program with few connections makes; and large tasks. A process of its own, so that what it computes delays neither the
manager nor who measures. Prints a line for each thousand tasks of the flood.

    KUBECONFIG=… python -m benchmarks.attacks.attacker NAMESPACE [--bombs 8] [--flood 10000] [--large 40]
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
from collections.abc import Iterator
from typing import Any

from application_manager.cluster.client import manager_client
from benchmarks.manager_memory import large as small
from benchmarks.task_to_deployment import AT_ONCE, TASKS, TEMPLATE, TEMPLATES, task
from tests.worker_jobs import TEXT
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import load_configuration
from wayside.kubernetes.errors import ApiError

LARGE = 1_000_000  # bytes of a large task
TEXT_LENGTH = 60_000  # of each of its values: the API server takes no more than 65,536
BOMB_EVERY = 2.0  # s between two changes of a bomb's values


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


def large(namespace: str, number: int) -> dict[str, Any]:
    """A task with about a megabyte of text."""
    made = small(namespace, number, 0)
    values = {f"x{index}": "x" * TEXT_LENGTH for index in range(LARGE // TEXT_LENGTH)}
    return {**made, "spec": {**made["spec"], "event": {**made["spec"]["event"], "values": values}}}


class Attacker:
    """An account that may write tasks and templates in a namespace."""

    def __init__(self, client: Client, namespace: str) -> None:
        self._client = client
        self._namespace = namespace
        self.made = 0

    async def bombing(self, number: int) -> None:
        """Make a bomb, and give it other values again and again, until cancelled."""
        await self._client.create(TEMPLATES, bomb(self._namespace, number))
        turn = 0
        while True:
            turn += 1
            items = [f"{turn}-{index}" for index in range(2000)]
            spec = {"templateName": f"bomb{number}", "parameters": {"l": items, "s": TEXT}}
            made = {**task(self._namespace, f"bomb{number}-{turn}"), "spec": spec}
            with contextlib.suppress(ApiError):
                raw = await self._client.create(TASKS, made)
                await asyncio.sleep(BOMB_EVERY)
                await self._client.delete(TASKS, self._namespace, made["metadata"]["name"], raw["metadata"]["uid"])

    async def flood(self, tasks: Iterator[dict[str, Any]]) -> None:
        """Make the tasks, AT_ONCE of them at a time."""
        async with asyncio.TaskGroup() as group:
            for _ in range(AT_ONCE):
                group.create_task(self._make(tasks))

    async def _make(self, tasks: Iterator[dict[str, Any]]) -> None:
        for each in tasks:
            with contextlib.suppress(ApiError):  # a refusal is expected: the attacker continues
                await self._client.create(TASKS, each)
                self.made += 1
                if self.made % 1000 == 0:
                    print(f"{self.made} tasks", flush=True)


async def attack(namespace: str, bombs: int, flood: int, larges: int) -> None:
    """Attack until the flood is over."""
    client = manager_client(await load_configuration())
    attacker = Attacker(client, namespace)
    every = max(1, flood // max(1, larges))

    def tasks() -> Iterator[dict[str, Any]]:
        for index in range(flood):
            yield task(namespace, f"flood{index}")
            if index % every == 0:
                yield large(namespace, index // every)

    try:
        async with asyncio.TaskGroup() as group:
            others = [group.create_task(attacker.bombing(number)) for number in range(bombs)]
            await attacker.flood(tasks())
            for each in others:
                each.cancel()
    finally:
        await client.close()


def main() -> None:
    """Run the attacks."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("namespace")
    for name, default in (("bombs", 8), ("flood", 10_000), ("large", 40)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    # Other machines' processors make an attack: on one machine it takes only the time that the others leave.
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    asyncio.run(attack(options.namespace, options.bombs, options.flood, options.large))


if __name__ == "__main__":
    main()
