"""Checks the API server's health, and Leases that seem to have expired."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.holders.leases import HolderKey
from application_manager.core.objects.policy import Name
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, RequestError, Unreachable
from wayside.kubernetes.leases import lease_name
from wayside.kubernetes.resources import LEASES, Resource

POLL_EVERY = 1.0  # s
_AT_ONCE = 8  # concurrent reads of Leases: few, because work on instances comes first

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LeaseWatch:
    """Measures the time in which the API server responds, by which Leases expire.

    `probe`: the resource to list for checking the API server and its storage, in one of the managed namespaces if there
    are any; `instance` enqueues an instance.
    """

    cache: ClusterCache
    client: Client
    probe: Resource
    namespaces: tuple[str, ...]
    instance: Callable[[Name], None]

    async def run(self) -> None:
        """Check until cancelled. Reading Leases never delays the health check, on which all Leases depend."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._measure(), name="health")
            group.create_task(self._read(), name="overdue leases")

    async def _measure(self) -> None:
        was_reached = True
        while True:
            reached = await self._reached()
            self.cache.healthy.note_check(time.monotonic(), succeeded=reached)
            if reached != was_reached:
                log.warning("the API server responds again" if reached else "the API server does not respond")
                was_reached = reached
            await asyncio.sleep(POLL_EVERY)

    async def _read(self) -> None:
        while True:
            if self.cache.healthy.reached:
                await self.read_due()
            await asyncio.sleep(POLL_EVERY)

    async def _reached(self) -> bool:
        try:
            await anext(self.client.pages(self.probe, next(iter(self.namespaces), None), size=1))
        except Unreachable:
            return False
        except ApiError as error:
            return error.code < 500
        return True

    async def read_due(self) -> None:
        """Read the Leases that were unchanged for longer than their duration; the watch reports changes as well.

        A Lease that cannot be read keeps its last observation, and does not affect the others.
        """
        at = self.cache.healthy.elapsed
        gate = asyncio.Semaphore(_AT_ONCE)
        due = [each for each in self.cache.claims.holders().items() if self.cache.leases.due(each[0], at)]
        problems = [each for each in await asyncio.gather(*(self._read_lease(*each, gate) for each in due)) if each]
        if problems:
            others = f", and {len(problems) - 1} more Leases cannot be read" if len(problems) > 1 else ""
            log.warning("leases: %s%s", problems[0], others)

    async def _read_lease(self, key: HolderKey, instances: Iterable[Name], gate: asyncio.Semaphore) -> Exception | None:
        """Read one Lease; returns the error, if any."""
        async with gate:
            try:
                raw = await self.client.get(LEASES, key[0], lease_name(key[1]))
            except RequestError as error:
                return error
        self.cache.leases.observe(key, raw, self.cache.healthy.elapsed)
        for instance in instances:
            self.instance(instance)
        return None
