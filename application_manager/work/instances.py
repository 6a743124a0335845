"""Reconciling one instance: decide, apply the instance, apply its objects. All the way in one go.

Nothing here waits for our own watch events: each answer of the API server enters the store, and the next step goes on
from it. What fails is tried again as a whole, from what is known then. How it went is noted in the cache's record of
the instance, and said afterwards (`instancestatus`).
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from application_manager.cache.cluster_cache import ClusterCache, Record
from application_manager.cluster.client import ApiError, Client, Object, Resource
from application_manager.core.claims.sizes import TOO_LARGE
from application_manager.core.conditions import Aspect, find
from application_manager.core.demand import drafting
from application_manager.core.demand.decisions import Decision
from application_manager.core.health.refusals import reason_of, with_remedy
from application_manager.core.objects.configuration import CONFIG_MAP, config_map_name
from application_manager.core.objects.ownership import Applied, Known, ObjectKey, references
from application_manager.core.objects.policy import Name
from application_manager.core.objects.rendering import Rendering, object_key
from application_manager.work.applying import Applier
from application_manager.work.attempts import Attempts
from application_manager.work.recorder import Reason, Recorder
from application_manager.work.suspending import Suspending
from wayside.api import ApplicationInstance

log = logging.getLogger(__name__)

_LOOK_AGAIN = 1.0  # s until an object that is on its way out is looked for again, should its watch event not come


@dataclass(frozen=True, slots=True)
class InstanceWork:
    """Reconciles instances.

    Attributes:
        instances: where ApplicationInstances live.
        tasks: where ApplicationTasks live.
        again: asks for an instance at a time, in seconds since 1970.
        enqueue: enqueues an instance.
        done: told when an instance's record is new.
        absent: told what was decided of an instance that neither exists nor should.
        observe: takes an object that was read.
        configured: told when an instance's configuration was applied.
        objects: the objects of an instance, or why it has none; None: they are being worked out, and the instance is
            asked again once they are.
        attempts: knows what was refused, and when it is tried again.
        not_made: told why an instance cannot be made that should be.
    """

    cache: ClusterCache
    client: Client
    applier: Applier
    recorder: Recorder
    suspending: Suspending
    instances: Resource
    tasks: Resource
    again: Callable[[Name, float], None]
    enqueue: Callable[[Name], None]
    done: Callable[[Name], None]
    absent: Callable[[Name, Decision | None], None]
    observe: Callable[[Object], None]
    configured: Callable[[Name], None]
    objects: Callable[[ApplicationInstance, drafting.TemplateState], Rendering | Aspect | None]
    attempts: Attempts = field(default_factory=Attempts)
    not_made: Callable[[Name, Decision, str], None] = lambda *_: None

    async def reconcile(self, name: Name) -> None:
        """Make the cluster match what is demanded of this instance.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        try:
            await self._reconcile(name)
        except ApiError as error:
            if error.terminating:
                log.debug("instance %s/%s: its namespace is going", *name)
                return
            raise

    async def _reconcile(self, name: Name) -> None:
        if self._is_unsettled(name):
            return  # what runs stays: who demands it is being worked out, and that brings us back
        await self._know_whether_it_was_made(name)
        decision = self._decide(name)
        if self._is_over(name, decision):
            # What we know may have holes (a watch that broke, for one): nothing is stopped without looking.
            await self._list_tasks(name)
            decision = self._decide(name)  # while the tasks were listed, the instance itself may have gone
            if decision is not None and self._is_over(name, decision) and await self._released(name, decision):
                return
        # From the decision to the first request nothing is awaited, so the decision is about what there is.
        instance = self.cache.instance(name)
        if decision is not None and decision.next_change is not None:
            self.again(name, decision.next_change)
        if decision is None or (instance is None and not decision.wanted):
            self.cache.records.pop(name, None)
            self.attempts.forget(name)
            self.absent(name, decision)
            return
        if instance is not None and instance.metadata.deletion_timestamp is not None:
            self.not_made(name, decision, f"instance {name[1]} is being removed, and is made again once it is gone")
            return  # its deletion brings us back
        await self._make(name, decision, instance)

    async def _make(self, name: Name, decision: Decision, existing: ApplicationInstance | None) -> None:
        if decision.paused and existing is not None:
            self._leave(name, decision, existing)
            return
        if decision.too_large and existing is None:
            self.not_made(name, decision, f"instance {name[1]} is not made: {decision.too_large}")
            return
        wanted = drafting.draft(name, decision, existing)
        template = self.cache.template((name[0], wanted.spec.template))
        rendering = self.objects(wanted, template)
        if rendering is None:
            return
        manifest = drafting.manifest(wanted, existing, template)
        looked: dict[ObjectKey, Object | None] = {}
        if manifest is not None:
            # Both at once: what to look for is known before the instance has a uid.
            to_look = rendering.manifests if existing is None and isinstance(rendering, Rendering) else ()
            if existing is None:
                self.cache.places.being_made.add(name)  # it takes its place from here on
            try:
                raw, looked = await asyncio.gather(
                    self.client.apply(self.instances, manifest), self.applier.look(name[0], to_look)
                )
            except ApiError as error:
                if existing is None and error.permanent and not error.terminating:
                    why = with_remedy(reason_of(error.code, error.message), error.message)
                    self.not_made(name, decision, f"instance {name[1]} cannot be made: {why}")
                raise
            self.observe(raw)
            self.cache.places.being_made.discard(name)
        instance = self.cache.instance(name)
        if instance is None or instance.metadata.deletion_timestamp is not None:
            return  # deleted by somebody meanwhile: its event brings us back
        known = self._known(name, instance)
        if not isinstance(rendering, Rendering):
            if rendering.reason == drafting.CHART_PENDING and self._was_applied(name, instance) is not None:
                return  # what runs stays as it is, and nothing is news until the chart is rendered, or has failed
            self._note(
                name, instance, decision, Applied(rendering, references(known.objects), complete=False), known.digest
            )
            return
        await self.suspending.settle(instance, rendering)
        instance = self.cache.instance(name) or instance
        pending = self.applier.pending(instance, rendering, known)
        was_applied = self._was_applied(name, instance)
        if not pending and was_applied is not None:
            self._note(name, instance, decision, Applied(was_applied, references(known.objects), True), known.digest)
            return
        trying = (instance.metadata.uid, rendering.digest)
        until = self.attempts.waits_until(name, trying, time.time())
        if until is not None and (record := self.cache.records.get(name)) is not None:
            self.again(name, until)
            self._note(name, instance, decision, record.applied, record.digest)
            return
        if existing is not None:
            looked = await self.applier.look(name[0], pending)
            if rendering.keys() - known.objects.keys():
                await self._announce(name, instance, known, rendering)
        try:
            applied = await self.applier.apply(instance, rendering, pending, known, looked)
        except ApiError as error:
            if not error.terminating:
                message = f"the API server failed and is asked again: {error.message}"
                failed = Applied(
                    Aspect("Applied", False, "Retrying", message), references(known.objects), complete=False
                )
                self._note(name, instance, decision, failed, known.digest)
            raise
        self._note(name, instance, decision, applied, rendering.digest if applied.complete else known.digest)
        if any(object_key(each) == (*CONFIG_MAP, config_map_name(name[1])) for each in pending):
            self.configured(name)
        if applied.complete:
            self.attempts.forget(name)
        elif applied.aspect.reason == "Waiting":
            self.again(name, time.time() + _LOOK_AGAIN)
        else:
            self.again(name, self.attempts.refused(name, trying, time.time()))

    async def _know_whether_it_was_made(self, name: Name) -> None:
        """Look for the instance where an attempt to make it failed, and so may have made it or not."""
        if name in self.cache.places.being_made:
            raw = await self.client.get(self.instances, name[0], name[1])
            if raw is not None:
                self.observe(raw)
            self.cache.places.being_made.discard(name)
            self.cache.places.touch(name)

    def _leave(self, name: Name, decision: Decision, instance: ApplicationInstance) -> None:
        """Note that the instance stays as it is, by a person's wish."""
        known = self._known(name, instance)
        message = "as it was when the instance was paused"
        aspect = (
            Aspect("Applied", True, "Applied", message)
            if self._was_applied(name, instance) is not None
            else Aspect("Applied", False, "Paused", "the instance was paused before all objects were applied")
        )
        applied = Applied(aspect, references(known.objects), complete=False)
        self._note(name, instance, decision, applied, known.digest)

    def _known(self, name: Name, instance: ApplicationInstance) -> Known:
        """What was applied so far: our own record where it is newer than the status."""
        record = self.cache.records.get(name)
        if record is not None and record.uid == instance.metadata.uid:
            return Known.read(record.digest, record.applied.objects)
        status = instance.status
        return Known.read(status.spec_hash, status.objects) if status else Known()

    def _was_applied(self, name: Name, instance: ApplicationInstance) -> Aspect | None:
        """The condition Applied, where it is True."""
        record = self.cache.records.get(name)
        if record is not None and record.uid == instance.metadata.uid:
            return record.applied.aspect if record.applied.aspect.holds else None
        kept = find(instance.status.conditions, "Applied") if instance.status else None
        return Aspect("Applied", True, kept.reason, kept.message) if kept and kept.status == "True" else None

    async def _announce(self, name: Name, instance: ApplicationInstance, known: Known, rendering: Rendering) -> None:
        """Write down what will belong to the instance, before any of it is applied.

        An instance that was just created does without: whatever bears its label and has it as controller is its own.
        """
        announced = references({**dict.fromkeys(rendering.keys()), **known.objects})
        status = {"objects": [each.to_json() for each in announced]}
        uid = instance.metadata.uid
        self.observe(await self.client.patch_status(self.instances, name[0], name[1], uid, status))

    def _note(
        self, name: Name, instance: ApplicationInstance, decision: Decision, applied: Applied, digest: str | None
    ) -> None:
        if decision.too_large and applied.aspect.holds:  # what it has is applied, and not what is demanded
            applied = replace(applied, aspect=Aspect("Applied", False, TOO_LARGE, decision.too_large))
        uid, before = instance.metadata.uid, self.cache.records.get(name)
        since = before.since if before is not None and before.uid == uid else time.time()
        self.cache.records[name] = Record(uid, decision, applied, digest, since)
        self.done(name)

    def _decide(self, name: Name) -> Decision | None:
        """Decide, and enqueue the instances that the decision concerns too."""
        decided = self.cache.decide(name, time.time())
        self.cache.note(name, decided)
        for each in decided.enqueue:
            self.enqueue((name[0], each))
        return decided.decision

    def _is_over(self, name: Name, decision: Decision | None) -> bool:
        """Whether the instance goes now: its linger is over, or another has its place."""
        instance = self.cache.instance(name)
        if instance is None or instance.metadata.deletion_timestamp is not None or decision is None:
            return False
        return decision.release_time is not None and decision.release_time <= time.time()

    async def _list_tasks(self, name: Name) -> None:
        instance = self.cache.instance(name)
        fields = f"spec.template={instance.spec.template}" if instance is not None else ""
        async for page, _ in self.client.pages(self.tasks, name[0], fields=fields):
            for raw in page:
                self.observe(raw)

    async def _released(self, name: Name, over: Decision) -> bool:
        """Delete the instance, unless claims of tasks are still being worked out; whether it was deleted."""
        instance = self.cache.instance(name)
        if instance is None:
            return False
        if self.cache.claims.pending((name[0], instance.spec.template)):
            self.again(name, time.time() + _LOOK_AGAIN)  # one of the tasks that were listed may demand it
            return False
        await self.client.delete(self.instances, name[0], name[1], instance.metadata.uid)
        why = over.yields or "no demand came within its linger"
        self.recorder.say(instance, Reason.PREEMPTED if over.yields else Reason.RELEASED, why, time.time())
        log.info("instance %s/%s: released: %s", *name, why)
        return True

    def _is_unsettled(self, name: Name) -> bool:
        instance = self.cache.instance(name)
        return instance is not None and self.cache.claims.unsettled((name[0], instance.spec.template))
