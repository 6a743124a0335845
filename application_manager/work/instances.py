"""Reconciles one instance: decides, applies the instance, applies its objects, in one pass.

It waits for none of our own watch events: each response of the API server enters the store, and the next step uses it.
After a failure, the whole pass is retried, with the state at that time. The result is noted in the cache's record of
the instance, and reported afterwards (`instancestatus`).
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from application_manager.cache.cluster_cache import INSTANCES, TASKS, ClusterCache, WorkRecord
from application_manager.core.claims.claims import TemplateState
from application_manager.core.claims.merging import TOO_LARGE
from application_manager.core.conditions import ConditionState, find
from application_manager.core.demand import drafting
from application_manager.core.demand.decisions import Decision
from application_manager.core.health.refusals import reason_of, with_remedy
from application_manager.core.objects import trimming
from application_manager.core.objects.configuration import config_map_key
from application_manager.core.objects.ownership import ApplyResult, LastApplied, ObjectKey, object_key, references
from application_manager.core.objects.policy import Name
from application_manager.core.objects.rendering import Rendering
from application_manager.work.applying import Applier
from application_manager.work.recorder import EventReason, Recorder
from application_manager.work.scaling import WorkloadScaler
from wayside.api import ApplicationInstance
from wayside.api.documents import parse_object
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object
from wayside.process.backoff import pause_after

log = logging.getLogger(__name__)

_RECHECK_AFTER = 1.0  # s until an object that is being deleted is read again, in case its watch event is missing
FIRST_PAUSE = 1.0  # s until the first retry after a refusal, doubled with each further refusal of the same content
LONGEST_PAUSE = 30.0  # s


@dataclass(frozen=True, slots=True)
class _Start:
    """The input of the work on one instance, read from the cache at once, so it is consistent.

    `existing` is None if the instance is to be created; `record`: the result of this process's last work on it.
    """

    name: Name
    decision: Decision
    existing: ApplicationInstance | None
    template: TemplateState
    record: WorkRecord | None

    def record_of(self, instance: ApplicationInstance) -> WorkRecord | None:
        """The record, unless it is of another instance with the same name."""
        return self.record if self.record is not None and self.record.uid == instance.metadata.uid else None

    def last_applied(self, instance: ApplicationInstance) -> LastApplied:
        """The last apply: from the record if there is one, because it is newer than the status."""
        if (record := self.record_of(instance)) is not None:
            return LastApplied.read(record.digest, record.applied.objects)
        status = instance.status
        return LastApplied.read(status.spec_hash, status.objects) if status else LastApplied()

    def was_applied(self, instance: ApplicationInstance) -> ConditionState | None:
        """The condition Applied, where it is True."""
        if (record := self.record_of(instance)) is not None:
            return record.applied.state if record.applied.state.holds else None
        kept = find(instance.status.conditions, "Applied") if instance.status else None
        return ConditionState("Applied", True, kept.reason, kept.message) if kept and kept.status == "True" else None


class Attempts:
    """When a refused apply is retried, by instance: with backoff, and immediately if the content has changed."""

    def __init__(self) -> None:
        self._refused: dict[Name, tuple[object, int, float]] = {}  # content, refusals, next attempt

    def waits_until(self, name: Name, what: object, now: float) -> float | None:
        """The time before which the same content is not retried, in seconds since 1970; None: it may be tried."""
        known, _, until = self._refused.get(name, (None, 0, 0.0))
        return until if known == what and now < until else None

    def note_refusal(self, name: Name, what: object, now: float) -> float:
        """Note that the content was refused; returns the time of the next attempt, in seconds since 1970."""
        known, times, _ = self._refused.get(name, (None, 0, 0.0))
        times = times + 1 if known == what else 1
        until = now + pause_after(times, FIRST_PAUSE, LONGEST_PAUSE)
        self._refused[name] = (what, times, until)
        return until

    def forget(self, name: Name) -> None:
        """Note a success, or the deletion of the instance."""
        self._refused.pop(name, None)


@dataclass(frozen=True, slots=True)
class InstanceWork:
    """Reconciles instances.

    Attributes:
        enqueue_at: enqueues an instance at a time, in seconds since 1970.
        done: called when there is a new record of an instance.
        absent: called with the decision about an instance that neither exists nor is to be created.
        configured: called when an instance's configuration was applied.
        objects: the objects of an instance, or why it has none; None: they are being computed, and the instance is
            enqueued once they are.
        not_created: called with the reason why an instance cannot be created.
    """

    cache: ClusterCache
    client: Client
    applier: Applier
    recorder: Recorder
    scaler: WorkloadScaler
    enqueue_at: Callable[[Name, float], None]
    enqueue: Callable[[Name], None]
    done: Callable[[Name], None]
    absent: Callable[[Name, Decision | None], None]
    observe: Callable[[Object], None]
    configured: Callable[[Name], None]
    objects: Callable[[ApplicationInstance, TemplateState], Rendering | ConditionState | None]
    attempts: Attempts = field(default_factory=Attempts)
    not_created: Callable[[Name, Decision, str], None] = lambda *_: None

    async def reconcile(self, name: Name) -> None:
        """Make the cluster match the decision about this instance. Raises RequestError for a temporary error."""
        try:
            await self._reconcile(name)
        except ApiError as error:
            if error.terminating:
                log.debug("instance %s/%s: its namespace is being deleted", *name)
                return
            raise

    async def _reconcile(self, name: Name) -> None:
        if self.cache.has_unresolved_claims(name):
            return  # the objects stay: the claims of its tasks are being computed, which enqueues it again afterwards
        if name in self.cache.places.being_created:
            await self._read_after_failed_create(name)
        decision = self._decide(name)
        if self._is_over(name, decision):
            # A watch may have missed events: nothing is stopped without listing the tasks.
            await self._list_tasks(name)
            decision = self._decide(name)  # the instance itself may have been deleted while the tasks were listed
            if decision is not None and self._is_over(name, decision) and await self._release(name, decision):
                return
        # There is no await from the decision to the first request, so the decision matches the cache.
        instance = self.cache.instance(name)
        if decision is not None and decision.next_change is not None:
            self.enqueue_at(name, decision.next_change)
        if decision is None or (instance is None and not decision.demanded):
            self.cache.records.pop(name, None)
            self.attempts.forget(name)
            self.absent(name, decision)
            return
        if instance is not None and instance.metadata.deletion_timestamp is not None:
            self.not_created(
                name, decision, f"instance {name[1]} is being deleted; the manager creates it again afterwards"
            )
            return  # the event of its deletion enqueues it again
        template = self.cache.template((name[0], decision.template))
        await self._ensure(_Start(name, decision, instance, template, self.cache.records.get(name)))

    async def _ensure(self, start: _Start) -> None:
        name, decision, existing = start.name, start.decision, start.existing
        if decision.paused and existing is not None:
            self._leave(start, existing)
            return
        if decision.too_large and existing is None:
            self.not_created(name, decision, f"cannot create instance {name[1]}: {decision.too_large}")
            return
        desired = drafting.draft(name, decision, existing)
        rendering = self.objects(desired, start.template)
        if rendering is None:
            return
        manifest = drafting.manifest(desired, existing, start.template)
        if manifest is None:
            if existing is not None:
                await self._apply_objects(start, existing, rendering, {})
            return
        answer, current = await self._apply_instance(start, manifest, rendering)
        try:
            instance = parse_object(trimming.own(answer))
            if isinstance(instance, ApplicationInstance) and instance.metadata.deletion_timestamp is None:
                await self._apply_objects(start, instance, rendering, current)
        finally:  # the instance enters the cache afterwards: no other work starts before its objects are applied
            self.observe(answer)
            self.cache.places.being_created.discard(name)

    async def _apply_instance(
        self, start: _Start, manifest: Object, rendering: Rendering | ConditionState
    ) -> tuple[Object, dict[ObjectKey, Object | None]]:
        """Apply the instance itself and, if it is new, read its objects at the same time: their keys are known."""
        to_read = rendering.manifests if start.existing is None and isinstance(rendering, Rendering) else ()
        if start.existing is None:
            self.cache.places.being_created.add(start.name)  # from now on it counts towards the limits
        try:
            return await asyncio.gather(
                self.client.apply(INSTANCES, manifest), self.applier.current_objects(start.name[0], to_read)
            )
        except ApiError as error:
            if start.existing is None and error.permanent and not error.terminating:
                why = with_remedy(reason_of(error.code, error.message), error.message)
                problem = f"cannot create instance {start.name[1]}: {why}"
                self.not_created(start.name, start.decision, problem)
            raise

    async def _apply_objects(
        self,
        start: _Start,
        instance: ApplicationInstance,
        rendering: Rendering | ConditionState,
        current: Mapping[ObjectKey, Object | None],
    ) -> None:
        name, last, was_applied = start.name, start.last_applied(instance), start.was_applied(instance)
        if not isinstance(rendering, Rendering):
            if rendering.reason == drafting.CHART_PENDING and was_applied is not None:
                return  # the objects stay unchanged until the chart is rendered, or has failed
            self._note(start, instance, ApplyResult(rendering, references(last.objects), complete=False), last.digest)
            return
        await self.scaler.scale_workloads(instance, rendering)
        trying = (instance.metadata.uid, rendering.digest)
        until = self.attempts.waits_until(name, trying, time.time())
        pending = self.applier.pending(instance, rendering, last)
        if not pending and was_applied is not None:
            self._note(start, instance, ApplyResult(was_applied, references(last.objects), True), last.digest)
            return
        if until is not None and start.record is not None:
            self.enqueue_at(name, until)
            self._note(start, instance, start.record.applied, start.record.digest)
            return
        if start.existing is not None:
            current = await self.applier.current_objects(name[0], pending)
            if rendering.keys() - last.objects.keys():
                await self._announce(instance, last, rendering)
        try:
            applied = await self.applier.apply(instance, rendering, pending, last, current)
        except ApiError as error:
            if not error.terminating:
                message = f"the API server failed; retrying with backoff: {error.message}"
                retrying = ConditionState("Applied", False, "Retrying", message)
                self._note(
                    start, instance, ApplyResult(retrying, references(last.objects), complete=False), last.digest
                )
            raise
        self._note(start, instance, applied, rendering.digest if applied.complete else last.digest)
        if any(object_key(each) == config_map_key(name[1]) for each in pending):
            self.configured(name)
        if applied.complete:
            self.attempts.forget(name)
        elif applied.state.reason == "Waiting":
            self.enqueue_at(name, time.time() + _RECHECK_AFTER)
        else:
            self.enqueue_at(name, self.attempts.note_refusal(name, trying, time.time()))

    async def _read_after_failed_create(self, name: Name) -> None:
        """Read the instance after a failed attempt to create it, which may have succeeded."""
        raw = await self.client.get(INSTANCES, name[0], name[1])
        if raw is not None:
            self.observe(raw)
        self.cache.places.being_created.discard(name)
        self.cache.places.touch(name)

    def _leave(self, start: _Start, instance: ApplicationInstance) -> None:
        """Note that the instance stays unchanged, because a person paused it."""
        last = start.last_applied(instance)
        message = "unchanged since the instance was paused"
        state = (
            ConditionState("Applied", True, "Applied", message)
            if start.was_applied(instance) is not None
            else ConditionState("Applied", False, "Paused", "the instance was paused before all objects were applied")
        )
        self._note(start, instance, ApplyResult(state, references(last.objects), complete=False), last.digest)

    async def _announce(self, instance: ApplicationInstance, last: LastApplied, rendering: Rendering) -> None:
        """Record the objects in the instance's status before any of them is applied.

        Not for an instance that was just created: every object with its label and it as controller belongs to it.
        """
        announced = references({**dict.fromkeys(rendering.keys()), **last.objects})
        status = {"objects": [each.to_json() for each in announced]}
        namespace, name, uid = instance.namespace, instance.name, instance.metadata.uid
        self.observe(await self.client.patch_status(INSTANCES, namespace, name, uid, status))

    def _note(self, start: _Start, instance: ApplicationInstance, applied: ApplyResult, digest: str | None) -> None:
        too_large = start.decision.too_large
        if too_large and applied.state.holds:  # its current values are applied, not the demanded ones
            applied = replace(applied, state=ConditionState("Applied", False, TOO_LARGE, too_large))
        before = start.record_of(instance)
        since = before.since if before is not None else time.time()
        metadata = instance.metadata
        self.cache.records[start.name] = WorkRecord(
            metadata.uid, metadata.generation, start.decision, applied, digest, since
        )
        self.done(start.name)

    def _decide(self, name: Name) -> Decision | None:
        """Decide, and enqueue the other instances that the decision concerns."""
        decided, others = self.cache.decide(name, time.time())
        self.cache.note(name, decided)
        for other in others:
            self.enqueue(other)
        return decided.decision

    def _is_over(self, name: Name, decision: Decision | None) -> bool:
        """Whether to release the instance now: its linger is over, or another has its place."""
        instance = self.cache.instance(name)
        if instance is None or instance.metadata.deletion_timestamp is not None or decision is None:
            return False
        return decision.release_time is not None and decision.release_time <= time.time()

    async def _list_tasks(self, name: Name) -> None:
        instance = self.cache.instance(name)
        fields = f"spec.templateName={instance.spec.template_name}" if instance is not None else ""
        async for page, _ in self.client.pages(TASKS, name[0], fields=fields):
            for raw in page:
                self.observe(raw)

    async def _release(self, name: Name, over: Decision) -> bool:
        """Delete the instance, unless claims of tasks are still being computed; whether it was deleted."""
        instance = self.cache.instance(name)
        if instance is None:
            return False
        if self.cache.claims.pending((name[0], instance.spec.template_name)):
            self.enqueue_at(name, time.time() + _RECHECK_AFTER)  # one of the listed tasks may demand it
            return False
        await self.client.delete(INSTANCES, name[0], name[1], instance.metadata.uid)
        why = over.yields or "no demand arrived within its linger"
        self.recorder.event(instance, EventReason.PREEMPTED if over.yields else EventReason.RELEASED, why, time.time())
        log.info("instance %s/%s: released: %s", *name, why)
        return True
