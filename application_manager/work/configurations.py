"""Announces an instance's configuration: to its pods, through the kubelet, and on Zenoh.

Level-triggered: the current content of the ConfigMap is compared with the last announcement to each pod, so the work
can be repeated at any time. It only saves time: without it, the kubelet writes the same content a minute later.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.objects.configuration import (
    ANNOTATION,
    config_map_key,
    fingerprint,
    selectors,
    unannounced_pods,
)
from application_manager.core.objects.ownership import controller_uid, reference_key
from application_manager.core.objects.policy import Name
from application_manager.work.applying import Applier
from application_manager.work.publishing import Publisher
from wayside.api import ApplicationInstance
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object, Resource

PODS = Resource("v1", "Pod", "pods")

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ConfigurationWork:
    """Announces configurations."""

    cache: ClusterCache
    client: Client
    applier: Applier
    publisher: Publisher

    async def reconcile(self, name: Name) -> None:
        """Publish the instance's configuration, and announce it to those of its pods that do not have it.

        Raises RequestError for a temporary error.
        """
        instance = self.cache.instance(name)
        live = self.applier.live(name[0], config_map_key(name[1]))
        if instance is None or live is None or controller_uid(live) != instance.metadata.uid:
            self.publisher.withdraw(name)
            return
        files = live.get("data") or {}
        self.publisher.publish(name, files)
        try:
            count = await self._announce(name, instance, fingerprint(files))
        except ApiError as error:
            if not error.permanent and not error.terminating:
                raise
            log.warning("instance %s/%s: cannot announce the new configuration; its pods get it late: %s", *name, error)
            return
        if count:
            log.info("instance %s/%s: announced the new configuration to %d pods", *name, count)

    async def _announce(self, name: Name, instance: ApplicationInstance, content: str) -> int:
        pods: dict[str, Object] = {}
        for selector in selectors(self._workloads(name, instance)):
            listed, _ = await self.client.list(PODS, name[0], labels=selector)
            pods |= {each["metadata"]["uid"]: each for each in listed}
        count = 0
        for pod, uid in unannounced_pods(pods.values(), name[1], content):
            try:
                await self.client.annotate(PODS, name[0], pod, uid, {ANNOTATION: content})
            except ApiError as error:
                if error.code not in (404, 409):  # deleted, or another pod of that name
                    raise
            else:
                count += 1
        return count

    def _workloads(self, name: Name, instance: ApplicationInstance) -> list[Object]:
        record, status = self.cache.record_of(instance), instance.status
        objects = record.applied.objects if record is not None else status.objects if status else ()
        found = (self.applier.live(name[0], reference_key(each)) for each in objects)
        return [each for each in found if each is not None]
