"""Pods that request a detector: what they get when they are created, from what the manager knows.

Before a pod goes without, its Detector is looked up at the API server: it may have been applied a moment before.
Whatever else goes wrong is no answer, and the pod is made without its detector (failurePolicy Ignore).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from application_manager.cache.cluster_cache import DETECTOR, ClusterCache
from application_manager.core.findings.injections import (
    Injection,
    PodRequest,
    answer_pod,
    detector_of,
    injection,
    read_pod,
)
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.measures import Measures
from wayside.api import Detector
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.resources import Object, Resource

LOOKING_UP = 3.0  # s for requests to the API server, which waits for us meanwhile

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Injecting:
    """Answers.

    Attributes:
        detectors: where Detectors live.
        observe: takes an object that was read.
        defaults: what holds for all detectors; None where the manager runs none.
    """

    cache: ClusterCache
    client: Client
    detectors: Resource
    observe: Callable[[Object], None]
    measures: Measures
    defaults: PodDefaults | None

    async def review(self, review: Any) -> Object:
        """The answer to an AdmissionReview about a pod. Raises ReviewError where it is none."""
        request = read_pod(review)
        name = detector_of(request.pod.get("metadata"))
        if name is None:
            return answer_pod(request, Injection())
        found = await self._found(request, name)
        if found.why_not is not None:
            await self._look_up(request.namespace, name)
            found = await self._found(request, name)
        self.measures.reviewed("Pod", "allowed" if found.why_not is None else "warned")
        return answer_pod(request, found)

    async def _found(self, request: PodRequest, name: str) -> Injection:
        entry = self.cache.store.get(DETECTOR, (request.namespace, name))
        detector = entry.model if entry is not None and isinstance(entry.model, Detector) else None
        metadata, spec = request.pod["metadata"], request.pod["spec"]
        # Beside the event loop: whether the Detector is accepted is found by compiling its expressions.
        return await asyncio.to_thread(injection, metadata, spec, request.namespace, detector, self.defaults)

    async def _look_up(self, namespace: str, name: str) -> None:
        try:
            async with asyncio.timeout(LOOKING_UP):
                for raw in (await self.client.list(self.detectors, namespace, fields=f"metadata.name={name}"))[0]:
                    self.observe(raw)
        except (ApiError, Unreachable, TimeoutError) as error:
            log.warning("cannot look up Detector %s/%s, which a pod requests: %s", namespace, name, error)
