"""Lists everything: once before the first decision, then periodically, in case a watch missed something."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from application_manager.cache.cluster_cache import OWN, ClusterCache
from application_manager.cache.store import name_of
from application_manager.core.objects.ownership import INSTANCE_LABEL
from application_manager.core.objects.policy import Name
from application_manager.measures import Measures
from application_manager.watching.router import Router
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import RequestError
from wayside.kubernetes.resources import LEASES, Resource
from wayside.kubernetes.retrying import until_answered

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Resync:
    """Lists our own kinds and those of instances' objects, in these namespaces, or in all if there are none.

    `every`: seconds between two resyncs.
    """

    cache: ClusterCache
    client: Client
    router: Router
    children: Sequence[Resource]
    namespaces: tuple[str, ...]
    every: float
    measures: Measures

    async def list_all(self) -> None:
        """List everything, however long the API server takes to respond. Raises ApiError if it refuses permanently."""
        await until_answered(self._everything)
        self.measures.resynced(succeeded=True)

    async def resync(self, watching: asyncio.Event) -> None:
        """List everything periodically, after the watches have started, until cancelled."""
        await watching.wait()
        await asyncio.sleep(self.every)
        while True:
            began = time.monotonic()
            try:
                await self._everything()
            except RequestError as error:
                log.warning("cannot list all objects; retrying at the next resync, in %g s: %s", self.every, error)
                self.measures.resynced(succeeded=False)
            else:
                self.measures.resynced(succeeded=True)
            self.cache.leases.forget_except(self.cache.claims.holders())
            await asyncio.sleep(max(0.0, self.every - (time.monotonic() - began)))

    async def relist(self, of_kopf: Any, namespace: str | None, labels: str) -> None:
        """List one of kopf's resources, in a namespace or (None) in all; route its objects and missed deletions.

        Raises RequestError.
        """
        for resource in (LEASES, *OWN.values(), *self.children):
            if (resource.group, resource.plural) == (of_kopf.group, of_kopf.plural):
                await self._list(resource, labels, (namespace,))

    async def _everything(self) -> None:
        for resource in OWN.values():
            await self._list(resource, "", self.namespaces)
        await asyncio.gather(*(self._list(resource, INSTANCE_LABEL, self.namespaces) for resource in self.children))
        self.router.enqueue_everything()

    async def _list(self, resource: Resource, labels: str, namespaces: Sequence[str | None]) -> None:
        for namespace in namespaces or (None,):
            present, version = set[Name](), "0"
            async for page, as_of in self.client.pages(resource, namespace, labels=labels):
                version = as_of
                for raw in page:
                    present.add(name_of(raw))
                    self.router.observe(raw)
            kind = (resource.api_version, resource.kind)
            for entry in self.cache.store.missing(kind, present, version, namespace):
                self.router.deleted(entry.raw)
