"""An API server in memory, as far as making the objects of one instance needs one, and the work on that instance."""

from __future__ import annotations

from collections.abc import AsyncIterator
from copy import deepcopy
from typing import cast

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.cache.store import Entry
from application_manager.core.objects.policy import Name, Policy
from application_manager.work.applying import Applier
from application_manager.work.instances import InstanceWork
from application_manager.work.recorder import Recorder
from application_manager.work.scaling import WorkloadScaler
from tests.inprocess import objects
from wayside.api import ApplicationTask, Kind
from wayside.api.base import API_VERSION
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object, Resource

CONFIG_MAPS = Resource("v1", "ConfigMap", "configmaps")


class MemoryServer:
    """Objects by kind and name; a uid in a request is a precondition, as it is for the real one."""

    def __init__(self, *objects: Object) -> None:
        self.objects: dict[tuple[str, str], Object] = {}
        self.written: list[tuple[str, str, str]] = []
        """The operations with kind and name, in order."""
        self._number = 0
        for each in objects:
            self.put(each)

    def put(self, raw: Object) -> Object:
        """Make or replace an object; it is another one from then on, unless it has a uid."""
        self._number += 1
        metadata = {"uid": f"uid-{self._number}", **raw["metadata"], "resourceVersion": str(self._number)}
        self.objects[raw["kind"], raw["metadata"]["name"]] = {**deepcopy(raw), "metadata": metadata}
        return deepcopy(self.objects[raw["kind"], raw["metadata"]["name"]])

    async def check_granted(self, namespace: str) -> None:
        """It may write in all namespaces."""

    async def get(self, resource: Resource, namespace: str, name: str) -> Object | None:
        return deepcopy(self.objects.get((resource.kind, name)))

    async def list(self, resource: Resource, *_: object, **__: object) -> tuple[list[Object], str]:
        return [deepcopy(each) for (kind, _), each in self.objects.items() if kind == resource.kind], str(self._number)

    async def pages(self, resource: Resource, *_: object, **__: object) -> AsyncIterator[tuple[list[Object], str]]:
        yield await self.list(resource)

    async def apply(self, resource: Resource, body: Object) -> Object:
        name = body["metadata"]["name"]
        there = self.objects.get((resource.kind, name), {"metadata": {}})
        self._check(there, body["metadata"].get("uid"))
        self.written.append(("apply", resource.kind, name))
        return self.put({**there, **body, "metadata": {**there["metadata"], **body["metadata"]}})

    async def patch_status(self, resource: Resource, namespace: str, name: str, uid: str, status: Object) -> Object:
        there = self.objects[resource.kind, name]
        self._check(there, uid)
        self.written.append(("status", resource.kind, name))
        return self.put({**there, "status": {**there.get("status", {}), **status}})

    async def delete(self, resource: Resource, namespace: str, name: str, uid: str) -> bool:
        self._check(self.objects[resource.kind, name], uid)
        self.written.append(("delete", resource.kind, name))
        del self.objects[resource.kind, name]
        return True

    @staticmethod
    def _check(there: Object, uid: str | None) -> None:
        if uid is not None and there["metadata"].get("uid") != uid:
            raise ApiError(409, "Precondition failed: UID in precondition differs from UID in object meta")


def work_on(cache: ClusterCache, server: object, absent: list[Name]) -> InstanceWork:
    """The work on instances, with that server; the instances that neither exist nor should go into `absent`."""
    client = cast("Client", server)
    applier = Applier(client, cache.store, {("v1", "ConfigMap"): CONFIG_MAPS})
    return InstanceWork(
        cache=cache,
        client=client,
        applier=applier,
        recorder=Recorder(client),
        scaler=WorkloadScaler(client, applier, cache.store.put),
        enqueue_at=lambda name, at: None,
        enqueue=lambda name: None,
        done=lambda name: None,
        absent=lambda name, decision: absent.append(name),
        observe=cache.store.put,
        configured=lambda name: None,
        objects=objects,
    )


def a_cache(*known: Object, task: ApplicationTask) -> ClusterCache:
    """A cache that knows these objects, and a task for template app."""
    cache = ClusterCache(Policy())
    for each in known:
        assert cache.store.put(each) is not None
    cache.claims.note((task.namespace, task.name), Entry(task.to_json(), task), cache.template((task.namespace, "app")))
    return cache


def raw(model: Kind, version: int) -> Object:
    """The object as the API server would give it."""
    made = {"apiVersion": API_VERSION, **model.to_json()}
    return {**made, "metadata": {"uid": f"uid-{version}", **made["metadata"], "resourceVersion": str(version)}}
