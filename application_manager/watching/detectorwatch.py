"""Lists the objects of the detectors that the manager runs, and the pods with sidecars, every few seconds.

There are few of them, and a list contains everything that a watch could have missed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from application_manager.cache.cluster_cache import DETECTOR, ClusterCache
from application_manager.cache.detector_index import DetectorIndex
from application_manager.core.objects.detectors import KINDS, SELECTOR
from application_manager.core.objects.policy import Name
from application_manager.core.objects.sidecars import SIDECAR_LABEL
from wayside.kubernetes.client import Client
from wayside.kubernetes.resources import Object, Resource
from wayside.kubernetes.retrying import repeatedly

POLL_EVERY = 3.0  # s
_KINDS = tuple(Resource(*each) for each in KINDS)
_PODS = Resource("v1", "Pod", "pods")


@dataclass(frozen=True, slots=True)
class DetectorWatch:
    """Lists in these namespaces, or in all if there are none; `detector` enqueues a Detector."""

    cache: ClusterCache
    client: Client
    index: DetectorIndex
    namespaces: tuple[str, ...]
    detector: Callable[[Name], None]

    async def run(self) -> None:
        """List the objects until cancelled, if the manager runs detectors."""
        if self.index.defaults is None:
            await asyncio.Event().wait()
        await repeatedly(self.refresh, POLL_EVERY, "cannot list the objects of detectors")

    async def refresh(self) -> None:
        """List the objects once, and enqueue all Detectors. Raises ApiError or Unreachable."""
        objects: list[Object] = []
        for resource in _KINDS:
            objects += await self._list(resource, SELECTOR)
        before = set(self.index.requesting)
        self.index.replace(objects, await self._list(_PODS, SELECTOR), await self._list(_PODS, SIDECAR_LABEL))
        for name in {
            *before,
            *self.index.requesting,
            *(name for name, _ in self.cache.store.all(DETECTOR)),
        }:
            self.detector(name)

    async def _list(self, resource: Resource, labels: str) -> list[Object]:
        found: list[Object] = []
        for namespace in self.namespaces or (None,):
            found += (await self.client.list(resource, namespace, labels=labels))[0]
        return found
