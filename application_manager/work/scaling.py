"""Scales an instance's workloads to zero and back, even if the manager is killed in between.

Their replica counts are written into the instance's status before any workload changes, and removed only when all have
been restored. So the status always shows the remaining work, and the objects show the finished work.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from application_manager.cache.cluster_cache import INSTANCES
from application_manager.core.objects.ownership import ObjectKey, controller_uid, reference_key
from application_manager.core.objects.rendering import Rendering
from application_manager.work.applying import Applier
from wayside.api import ApplicationInstance
from wayside.api.applicationinstance import SuspendedReplicas
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object

_ATTEMPTS = 5  # attempts to scale an object that another client keeps changing

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class WorkloadScaler:
    """Scales the workloads of instances."""

    client: Client
    applier: Applier
    observe: Callable[[Object], None]

    async def scale_workloads(self, instance: ApplicationInstance, rendering: Rendering) -> None:
        """Scale the workloads to zero or back, as the instance's spec requires, before its manifests are applied.

        Raises ApiError or Unreachable for a temporary error.
        """
        noted = {
            reference_key(each): each.replicas
            for each in (instance.status.suspended_replicas if instance.status else ())
        }
        if instance.spec.suspended:
            await self._stop(instance, rendering, noted)
        elif noted:
            await self._resume(instance, rendering, noted)

    async def _stop(self, instance: ApplicationInstance, rendering: Rendering, noted: dict[ObjectKey, int]) -> None:
        to_stop = [key for key in rendering.replicas if key not in noted or not self._is_at_zero(instance, key)]
        live = {key: await self._own(instance, key) for key in to_stop}
        missing = {}
        for key in to_stop:
            if key not in noted:
                raw, stated = live[key], rendering.replicas[key]
                missing[key] = int(raw["spec"].get("replicas", 1)) if raw else 1 if stated is None else stated
        desired = {key: replicas for key, replicas in noted.items() if key in rendering.replicas} | missing
        if desired != noted:
            await self._note(instance, desired)
        for key, raw in live.items():
            if raw is not None:
                await self._scale(instance, key, raw, 0)

    async def _resume(self, instance: ApplicationInstance, rendering: Rendering, noted: dict[ObjectKey, int]) -> None:
        for key, before in noted.items():
            raw = await self._own(instance, key) if key in rendering.replicas else None
            if raw is not None and raw["spec"].get("replicas", 1) == 0:
                stated = rendering.replicas[key]
                await self._scale(instance, key, raw, before if stated is None else stated)
        await self._note(instance, {})

    def _is_at_zero(self, instance: ApplicationInstance, key: ObjectKey) -> bool:
        """Whether the watched object has no replicas; an object that does not exist is created without any."""
        live = self.applier.live(instance.namespace, key)
        return live is None or live["spec"].get("replicas", 1) == 0

    async def _own(self, instance: ApplicationInstance, key: ObjectKey) -> Object | None:
        """The object, read again; None if there is none, or it does not belong to the instance."""
        raw = await self.client.get(await self.applier.resource(key), instance.namespace, key[2])
        return raw if raw is not None and controller_uid(raw) == instance.metadata.uid else None

    async def _scale(self, instance: ApplicationInstance, key: ObjectKey, raw: Object, replicas: int) -> None:
        resource, current = await self.applier.resource(key), raw
        for attempt in range(_ATTEMPTS):
            if current["spec"].get("replicas", 1) == replicas:
                return
            version = current["metadata"]["resourceVersion"]
            try:
                await self.client.scale(resource, instance.namespace, key[2], version, replicas)
            except ApiError as error:
                if error.code != 409 or attempt == _ATTEMPTS - 1:
                    raise
                found = await self._own(instance, key)
                if found is None:
                    return
                current = found
            else:
                log.info("instance %s/%s: %s %s to %d replicas", *_name(instance), key[1], key[2], replicas)
                return

    async def _note(self, instance: ApplicationInstance, replicas: dict[ObjectKey, int]) -> None:
        noted = [
            SuspendedReplicas(api_version=key[0], kind=key[1], name=key[2], replicas=count).to_json()
            for key, count in sorted(replicas.items())
        ]
        status = {"suspendedReplicas": noted}
        uid = instance.metadata.uid
        self.observe(await self.client.patch_status(INSTANCES, *_name(instance), uid, status))


def _name(instance: ApplicationInstance) -> tuple[str, str]:
    return instance.namespace, instance.name
