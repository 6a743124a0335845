"""Looking at the API server's health, and at Leases that seem to have lapsed."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from application_manager.client import LEASES, ApiError, Client, Resource, Unreachable
from application_manager.core.leases import lease_name
from application_manager.store import Name
from application_manager.world import World

LOOK_EVERY = 1.0  # s

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LeaseWatch:
    """Measures the time in which we reach the API server, on which Leases lapse.

    Attributes:
        probe: what is listed to see whether the API server and its storage answer.
        namespaces: where; empty: anywhere.
        instance: asks for an instance to be reconciled.
    """

    world: World
    client: Client
    probe: Resource
    namespaces: tuple[str, ...]
    instance: Callable[[Name], None]

    async def run(self) -> None:
        """Look until cancelled."""
        was_reached = True
        while True:
            reached = await self._reached()
            self.world.healthy.look(time.monotonic(), succeeded=reached)
            if reached != was_reached:
                log.warning("the API server answers again" if reached else "the API server does not answer")
                was_reached = reached
            if reached:
                try:
                    await self._read_due()
                except (ApiError, Unreachable) as error:
                    log.warning("leases: %s", error)
            await asyncio.sleep(LOOK_EVERY)

    async def _reached(self) -> bool:
        try:
            await self.client.list(self.probe, next(iter(self.namespaces), None), limit=1)
        except Unreachable:
            return False
        except ApiError as error:
            return error.code < 500
        return True

    async def _read_due(self) -> None:
        """Read the Leases that are unchanged for longer than they last; news of them also come by watching."""
        at = self.world.healthy.elapsed
        for (namespace, holder), instances in self.world.claims.holders().items():
            if not self.world.leases.due((namespace, holder), at):
                continue
            raw = await self.client.get(LEASES, namespace, lease_name(holder))
            self.world.leases.observe((namespace, holder), raw, self.world.healthy.elapsed)
            for instance in instances:
                self.instance(instance)
