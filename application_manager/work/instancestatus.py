"""Writes the status and the Events of an instance after the work, and enqueues its tasks.

It has its own queue, so that statuses never delay the work. Until a status is written, the cache's record of the
instance replaces it; if the manager is killed before, the next one repeats the work, and has nothing to change.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from application_manager.cache.cluster_cache import INSTANCES, ClusterCache, LastDecision, WorkRecord
from application_manager.cluster.polls import FailedPodsPoll, NodePoll
from application_manager.core.conditions import ConditionState
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.fallback import READY_TIMEOUT
from application_manager.core.demand.lingering import PAUSE_ANNOTATION
from application_manager.core.health.placement import selects_nodes, unschedulable
from application_manager.core.health.pods import Trouble, summary
from application_manager.core.health.readiness import is_unobserved, not_ready
from application_manager.core.health.refusals import has_too_few_pods, refused_by_events, refused_pods
from application_manager.core.objects.ownership import ApplyResult, ObjectKey, reference_key
from application_manager.core.objects.policy import Name
from application_manager.core.statuses.status import InstanceProgress, instance_status, suspended_condition
from application_manager.work.applying import Applier
from application_manager.work.recorder import EventReason
from application_manager.work.statuses import StatusWriter
from wayside.api import ApplicationInstance
from wayside.api.applicationinstance import ApplicationInstanceStatus
from wayside.kubernetes.resources import Object

_TROUBLES_SHOWN = 3
_FIRST_STATUS_DELAY = 2.0  # s
_RECHECK_AFTER = 5.0  # s until nodes and Events are read again for objects that are not ready because of them

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class InstanceStatusWork:
    """Writes statuses of instances.

    `enqueue_at` enqueues an instance at a time, in seconds since 1970; `task_changed` enqueues a task.
    """

    cache: ClusterCache
    statuses: StatusWriter
    applier: Applier
    task_changed: Callable[[Name], None]
    nodes: NodePoll
    failed_pods: FailedPodsPoll
    enqueue_at: Callable[[Name, float], None]

    async def reconcile(self, name: Name) -> None:
        """Write the instance's status if it differs. Raises RequestError for a temporary error."""
        instance = self.cache.instance(name)
        if instance is None or (record := self.cache.record_of(instance)) is None:
            return
        looked_up = await self._looked_up(instance, record.applied)
        instance = self.cache.instance(name)
        if instance is None or (record := self.cache.record_of(instance)) is None:
            return
        now = time.time()
        old = instance.status or ApplicationInstanceStatus()
        applied = record.applied
        live = self._live(instance, applied)
        until = _delayed_until(instance, record, live.values())
        troubles = self._troubles(name, live, looked_up)
        suspended = suspended_condition(instance, record.decision, live.values())
        ready = _overdue(self._ready(instance, applied.state, live, troubles), record.decision)
        new = instance_status(
            instance,
            record.decision,
            applied.state,
            ready,
            applied.objects,
            record.digest,
            now,
            record.generation,
            suspended,
        )
        if until > now and instance.status != new:
            self.enqueue_at(name, until)
        elif not await self.statuses.write(INSTANCES, instance, instance.status, new, now):
            return
        elif old.release_time is None and new.release_time is not None:
            note = f"no demand is left; the instance will be released at {new.release_time} unless a demand arrives"
            self.statuses.recorder.event(instance, EventReason.LINGERING, note, now)
        # The number of ready pods is only in the instance's status: it changes often, and there may be many tasks.
        why_not = "" if applied.state.holds else applied.state.message
        reason = ""
        if applied.state.holds and suspended is not None and instance.spec.suspended:
            why_not, reason = suspended.message, ready.reason
        elif applied.state.holds and not ready.holds and troubles:
            why_not, reason = _text(troubles), ready.reason
        if record.decision.overdue and not ready.holds and not instance.spec.suspended:
            late = f"instance {name[1]} was not ready for {record.decision.overdue}"
            why_not, reason = ": ".join(filter(None, (late, why_not))), reason or READY_TIMEOUT
        if record.decision.withheld and applied.state.holds:
            why_not = f"instance {name[1]} is paused (annotation {PAUSE_ANNOTATION}): the task's values are not applied"
        serves = applied.state.holds and not record.decision.withheld
        progress = InstanceProgress(
            name[1],
            serves,
            serves and ready.holds,
            why_not,
            reason,
            suspended=instance.spec.suspended,
            stopped=serves and suspended is not None and suspended.holds,
        )
        self.report(name, record.decision, progress)

    def report_not_created(self, name: Name, decision: Decision, problem: str) -> None:
        """Enqueue the tasks that demand an instance that does not exist, with the reason."""
        self.report(name, decision, InstanceProgress(name[1], applied=False, ready=False, problem=problem))

    def report(self, name: Name, decision: Decision | None, progress: InstanceProgress | None) -> None:
        """Enqueue the tasks whose verdict or progress changed; the progress is None if there is no instance."""
        old = self.cache.last_decisions.pop(name, None)
        verdicts = decision.verdicts if decision is not None else {}
        before = old.decision.verdicts if old is not None else {}
        for task in before.keys() - verdicts.keys():
            self.task_changed((name[0], task))  # a task for all instances may have others yet
        if decision is None:
            return
        new = LastDecision(decision, progress or InstanceProgress(name[1], applied=False, ready=False))
        self.cache.last_decisions[name] = new
        all_changed = old is None or (old.progress, old.decision.fallback) != (new.progress, decision.fallback)
        known = old.decision.generations if old is not None else {}
        for task, verdict in verdicts.items():
            if all_changed or (before.get(task), known.get(task)) != (verdict, decision.generations[task]):
                self.task_changed((name[0], task))

    def _troubles(
        self, name: Name, objects: Mapping[ObjectKey, Object | None], looked_up: Sequence[Trouble]
    ) -> list[Trouble]:
        """The problems of its pods, and why pods cannot be created or fit no node."""
        refused = [found for each in objects.values() if each is not None and (found := refused_pods(each)) is not None]
        return summary([*self.cache.pods.troubles(name), *refused, *looked_up])

    async def _looked_up(self, instance: ApplicationInstance, applied: ApplyResult) -> list[Trouble]:
        """The causes of unready objects that no watch reports: no node meets the requirements, pods are refused."""
        if instance.spec.suspended:
            return []
        live = [each for each in self._live(instance, applied).values() if each is not None and not_ready(each)]
        found = [*await self._misfits(live), *await self._refused(live)]
        if found or any(has_too_few_pods(each) for each in live):
            self.enqueue_at((instance.namespace, instance.name), time.time() + _RECHECK_AFTER)
        return found

    async def _misfits(self, live: Sequence[Object]) -> list[Trouble]:
        """The objects whose requirements no node meets."""
        bound = [each for each in live if selects_nodes(each)]
        nodes = await self.nodes.labels() if bound else None
        return (
            [] if nodes is None else [trouble for each in bound if (trouble := unschedulable(each, nodes)) is not None]
        )

    async def _refused(self, live: Sequence[Object]) -> list[Trouble]:
        """Why pods of the objects are refused, for objects of which only Events report it."""
        without_pods = [each["metadata"] for each in live if has_too_few_pods(each)]
        troubles = [
            refused_by_events(await self.failed_pods.events(each["namespace"], each["uid"]), time.time())
            for each in without_pods
        ]
        return [each for each in troubles if each is not None]

    def _live(self, instance: ApplicationInstance, applied: ApplyResult) -> dict[ObjectKey, Object | None]:
        """The instance's objects, as watched."""
        keys = map(reference_key, applied.objects)
        return {key: self.applier.live(instance.namespace, key) for key in keys}

    def _ready(
        self,
        instance: ApplicationInstance,
        applied: ConditionState,
        objects: Mapping[ObjectKey, Object | None],
        troubles: Sequence[Trouble],
    ) -> ConditionState:
        missing = []
        for (_, kind, name), live in objects.items():
            problem = "does not exist" if live is None else not_ready(live)
            if problem is not None:
                missing.append(f"{kind} {name} {problem}")
        if not objects:
            return ConditionState("Ready", False, "NotApplied", "nothing is applied yet")
        if not applied.holds:  # the previous version may run, but it is not the demanded one
            return ConditionState("Ready", False, applied.reason, f"not applied: {applied.message}")
        if instance.spec.suspended:
            return ConditionState("Ready", False, "Suspended", "the instance is suspended")
        if missing:
            reason = troubles[0].reason.value if troubles else "NotReady"
            refused = [found for each in objects.values() if each is not None and (found := refused_pods(each))]
            others = [each for each in troubles if each not in refused]  # its message has the others
            return ConditionState("Ready", False, reason, ": ".join(filter(None, ("; ".join(missing), _text(others)))))
        return ConditionState("Ready", True, "Ready", "all workloads are ready")


def _delayed_until(instance: ApplicationInstance, record: WorkRecord, live: Iterable[Object | None]) -> float:
    """The time until which the first status of an instance is delayed, in seconds since 1970; 0: no delay.

    Controllers usually process the new objects within this time; without the delay, two statuses would follow each
    other.
    """
    known = instance.status is not None and instance.status.spec_hash is not None
    if known or not record.applied.state.holds or not any(each is not None and is_unobserved(each) for each in live):
        return 0.0
    return record.since + _FIRST_STATUS_DELAY


def _overdue(ready: ConditionState, decision: Decision) -> ConditionState:
    """The condition Ready of an overdue instance: its reason is ReadyTimeout, unless there is a more specific one."""
    if ready.holds or not decision.overdue or ready.reason == "Suspended":
        return ready
    reason = READY_TIMEOUT if ready.reason in ("NotReady", "NotApplied") else ready.reason
    return ConditionState("Ready", False, reason, f"not ready for {decision.overdue}: {ready.message}")


def _text(troubles: Sequence[Trouble]) -> str:
    """The most important problems, as text for a condition."""
    more = f"; and {len(troubles) - _TROUBLES_SHOWN} more" if len(troubles) > _TROUBLES_SHOWN else ""
    return "; ".join(each.text for each in troubles[:_TROUBLES_SHOWN]) + more
