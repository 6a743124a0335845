"""Applies an instance's rendered objects, and never changes objects of others.

Before the first apply of an object, the manager reads it: an existing object whose controller is not this instance is
not changed. Every later apply contains the uid, so an object that was replaced meanwhile causes a conflict and is not
overwritten. Objects that are no longer rendered are pruned, but only after everything else was applied, only with our
controller reference and with their uid as a precondition.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Iterable, Mapping, Sequence

from application_manager.cache.store import MembersByGroup, Store
from application_manager.core.conditions import ConditionState
from application_manager.core.health.refusals import (
    ADMISSION_REFUSED,
    APPLY_REFUSED,
    QUOTA_EXCEEDED,
    reason_of,
    with_remedy,
)
from application_manager.core.objects.ownership import (
    ApplyProblem,
    ApplyResult,
    LastApplied,
    Manifest,
    ObjectKey,
    controller_uid,
    foreign,
    object_key,
    our_fields,
    owned,
    references,
)
from application_manager.core.objects.policy import KindKey
from application_manager.core.objects.rendering import Rendering
from wayside.api import ApplicationInstance, Kind
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object, Resource

_WORST_FIRST = ("ObjectExists", APPLY_REFUSED, ADMISSION_REFUSED, QUOTA_EXCEEDED, "Waiting")
_WORKLOADS = frozenset({"Deployment", "StatefulSet", "DaemonSet", "Job", "CronJob", "Pod"})

log = logging.getLogger(__name__)


class Applier:
    """Applies and prunes objects, and detects drift."""

    def __init__(self, client: Client, store: Store, resources: Mapping[KindKey, Resource]) -> None:
        self._client = client
        self._store = store
        self._resources = dict(resources)
        self._fields: dict[str, str] = {}  # uid → the fields that we owned after our last apply
        self._drifted: set[str] = set()
        self._controlled: MembersByGroup[str, str, ObjectKey] = MembersByGroup()  # uid of the controller → uid → object

    def live(self, namespace: str, key: ObjectKey) -> Object | None:
        """The object, if it is watched: it has an instance's label."""
        entry = self._store.get((key[0], key[1]), (namespace, key[2]))
        return entry.raw if entry is not None else None

    def note(self, raw: Object) -> None:
        """Note a watched object: if another client took over a field from us, the object has drifted."""
        uid, fields = raw["metadata"]["uid"], our_fields(raw)
        if self._fields.setdefault(uid, fields) != fields:
            self._drifted.add(uid)
        self._controlled.put(controller_uid(raw) or "", uid, object_key(raw))

    def has_drifted(self, uid: str) -> bool:
        """Whether another client took over a field of the object."""
        return uid in self._drifted

    def begin(self, objects: Iterable[Object]) -> None:
        """Forget all drift: until now, another manager may have been active and have changed the objects."""
        self._fields.clear()
        self._drifted.clear()
        for raw in objects:
            self.note(raw)

    def forget(self, raw: Object) -> None:
        """Note that an object was deleted."""
        uid = raw["metadata"]["uid"]
        self._fields.pop(uid, None)
        self._drifted.discard(uid)
        self._controlled.drop(controller_uid(raw) or "", uid)

    def pending(self, instance: ApplicationInstance, rendering: Rendering, last: LastApplied) -> list[Manifest]:
        """The manifests to apply: all of a new rendering, otherwise those that are missing or have drifted."""
        if last.digest != rendering.digest:
            return list(rendering.manifests)
        return [
            manifest
            for manifest in rendering.manifests
            if not self._is_as_recorded(instance.namespace, object_key(manifest), last.objects)
        ]

    def _is_as_recorded(self, namespace: str, key: ObjectKey, recorded: Mapping[ObjectKey, str | None]) -> bool:
        live = self.live(namespace, key)
        if live is None:
            return False
        uid = live["metadata"]["uid"]
        return uid == recorded.get(key) and uid not in self._drifted

    async def current_objects(self, namespace: str, manifests: Iterable[Manifest]) -> dict[ObjectKey, Object | None]:
        """The current objects in the cluster, unless they are watched."""
        keys = [key for key in map(object_key, manifests) if self.live(namespace, key) is None]
        found = await asyncio.gather(*(self._get(namespace, key) for key in keys))
        return dict(zip(keys, found, strict=True))

    async def apply(
        self,
        instance: ApplicationInstance,
        rendering: Rendering,
        manifests: Sequence[Manifest],
        last: LastApplied,
        current: Mapping[ObjectKey, Object | None],
    ) -> ApplyResult:
        """Apply all or some manifests of the rendering, and prune the objects that are no longer rendered.

        `current`: the result of `current_objects` for the same manifests. Raises ApiError or Unreachable for a
        temporary error, after all other objects were tried.
        """
        began = time.time_ns()
        desired = rendering.keys()
        recorded = dict(last.objects)
        supporting = [each for each in manifests if each["kind"] not in _WORKLOADS]
        workloads = [each for each in manifests if each["kind"] in _WORKLOADS]
        results: list[Object | ApplyProblem | BaseException] = []
        for phase in (supporting, workloads):
            results += await asyncio.gather(
                *(self._apply_one(instance, each, recorded, current) for each in phase), return_exceptions=True
            )
        for result in results:
            if isinstance(result, BaseException):
                raise result
        uids = dict(recorded)
        for result in results:
            if isinstance(result, dict):
                uids[object_key(result)] = result["metadata"]["uid"]
        problems = [result for result in results if isinstance(result, ApplyProblem)]
        if problems:
            there = references({**dict.fromkeys(desired), **uids})
            return ApplyResult(_refused(problems), there, complete=False, took=(began, time.time_ns()))
        # An object whose controller is the instance belongs to it, recorded or not.
        controlled = self._controlled.get(instance.metadata.uid, {})
        for key in (recorded.keys() | set(controlled.values())) - desired:
            await self._prune(instance, key)
            uids.pop(key, None)
        matching = "1 object matches" if len(desired) == 1 else f"{len(desired)} objects match"
        done = ConditionState("Applied", True, "Applied", f"{matching} the template")
        return ApplyResult(done, references(uids), complete=True, took=(began, time.time_ns()))

    async def _apply_one(
        self,
        instance: ApplicationInstance,
        manifest: Manifest,
        recorded: Mapping[ObjectKey, str | None],
        current: Mapping[ObjectKey, Object | None],
    ) -> Object | ApplyProblem:
        key = object_key(manifest)
        live = self.live(instance.namespace, key) or current.get(key)
        body = owned(manifest, instance)
        raw = await apply_owned(self._client, await self.resource(key), body, instance, live, recorded.get(key))
        if isinstance(raw, ApplyProblem):
            return raw
        uid = raw["metadata"]["uid"]
        self._fields[uid] = our_fields(raw)
        self._drifted.discard(uid)
        self.note(raw)
        self._store.put(raw)
        log.info("instance %s/%s: applied %s %s", instance.namespace, instance.name, key[1], key[2])
        return raw

    async def _prune(self, instance: ApplicationInstance, key: ObjectKey) -> None:
        live = await self._get(instance.namespace, key)
        if live is None or controller_uid(live) != instance.metadata.uid:
            return
        await self._client.delete(await self.resource(key), instance.namespace, key[2], live["metadata"]["uid"])
        log.info("instance %s/%s: pruned %s %s", instance.namespace, instance.name, key[1], key[2])

    async def _get(self, namespace: str, key: ObjectKey) -> Object | None:
        return await self._client.get(await self.resource(key), namespace, key[2])

    async def resource(self, key: ObjectKey) -> Resource:
        """The resource of the object's kind. Raises ApiError if the cluster does not have it."""
        kind = key[:2]
        if kind not in self._resources:  # a kind that was allowed before, or was added to the cluster after our start
            self._resources |= await self._client.discover(key[0])
        if kind not in self._resources:
            raise ApiError(404, f"the cluster has no kind {key[0]}/{key[1]}")
        return self._resources[kind]


async def apply_owned(
    client: Client,
    resource: Resource,
    manifest: Manifest,
    owner: Kind,
    live: Object | None,
    recorded: str | None = None,
) -> Object | ApplyProblem:
    """Apply an object with its owner as controller, unless it belongs to another; returns the object, or the problem.

    `live`: the current object, None if there is none; its uid is a precondition. `recorded`: its uid, if the owner's
    status lists it. Raises RequestError for a temporary error, and for a namespace that is being deleted.
    """
    what = f"{manifest['kind']} {manifest['metadata']['name']}"
    if live is not None:
        problem = foreign(live, owner, what, recorded)
        if problem is not None:
            return problem
        manifest = {**manifest, "metadata": {**manifest["metadata"], "uid": live["metadata"]["uid"]}}
    try:
        return await client.apply(resource, manifest)
    except ApiError as error:
        if error.code == 409:  # deleted or replaced since the manager read it
            return ApplyProblem("Waiting", f"{what} was deleted or replaced in the meantime; reading it again")
        if not error.permanent or error.terminating:
            raise
        reason = reason_of(error.code, error.message)
        return ApplyProblem(reason, with_remedy(reason, f"{what}: {_readable(error.message)}"))


def _refused(problems: Sequence[ApplyProblem]) -> ConditionState:
    worst = min(problems, key=lambda each: _WORST_FIRST.index(each.reason))
    return ConditionState("Applied", False, worst.reason, "; ".join(each.message for each in problems))


def _readable(message: str) -> str:
    """The API server's refusal, without the Go syntax around a wrong type."""
    typed = re.fullmatch(r"failed to create typed patch object \([^)]*\): \.?(.*)", message, re.DOTALL)
    if typed is None:
        return message
    plain = re.sub(r"&value\.valueUnstructured\{Value:(.*)\}", r"\1", typed[1], flags=re.DOTALL)
    if "expected string, got" in plain:
        plain += " (a value inside other text becomes a string; alone, it keeps its type)"
    return f"{plain}: correct the template"
