"""Statuses of tasks, instances and templates. Pure.

They are truthful (Ready means that the workload is ready) and quiet: the same state gives the same status, so nothing
known is written again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from application_manager.core.claims.operations import ACCEPTED, Verdict, VerdictKind
from application_manager.core.conditions import STALLED, ConditionState, concluded, cut, find, from_first, updated
from application_manager.core.demand import fallback
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.lingering import is_held, manual_conditions
from application_manager.core.findings.findings import Findings
from application_manager.core.objects.suspension import autoscalers, pods_left
from wayside.api import ApplicationInstance, ApplicationTask
from wayside.api.applicationinstance import ApplicationInstanceStatus, Demands, InstancePhase, ObjectReference
from wayside.api.applicationtask import ApplicationTaskStatus, TaskPhase
from wayside.api.applicationtemplate import ApplicationTemplateStatus, TemplateManager
from wayside.api.operation import Operation
from wayside.times import format_seconds, parse_seconds

Json = dict[str, Any]

_NAMES_SHOWN = 20
_PASSING = frozenset({"Retrying", "Paused"})
"""Reasons of Applied=False with phase Failed that require no change of the template."""

TEMPLATE_INVALID = "TemplateInvalid"
"""Reason of the condition Accepted of a template that cannot be rendered."""


@dataclass(frozen=True, slots=True)
class InstanceProgress:
    """The progress of an instance for its tasks.

    Attributes:
        applied: whether all objects are as they should be.
        ready: whether its workloads are ready.
        problem: why it is not applied or not ready, as text; empty if it only takes time.
        reason: the problem's reason, if it prevents readiness.
        suspended: whether it is to be scaled to zero.
        stopped: whether it is scaled to zero.
    """

    instance: str
    applied: bool
    ready: bool
    problem: str = ""
    reason: str = ""
    suspended: bool = False
    stopped: bool = False


def combined_progress(parts: Sequence[InstanceProgress]) -> InstanceProgress:
    """The combined progress of several instances, at least one, for a task for all instances."""
    return InstanceProgress(
        instance=", ".join(sorted(each.instance for each in parts)),
        applied=all(each.applied for each in parts),
        ready=all(each.ready for each in parts),
        problem="; ".join(sorted(each.problem for each in parts if each.problem)),
        reason=next((each.reason for each in parts if each.reason), ""),
        suspended=any(each.suspended for each in parts),
        stopped=all(each.stopped for each in parts),
    )


def task_status(
    task: ApplicationTask, verdict: Verdict, progress: InstanceProgress | None, now: float, generation: int
) -> ApplicationTaskStatus:
    """The task's status; `progress` is the progress of the verdict's instance.

    `generation`: the generation of the task that the verdict is based on: the task may have changed since. A finished
    task has no condition Applied or Ready: no more work is done for it.
    """
    old = task.status or ApplicationTaskStatus()
    since = format_seconds(now)
    finished = verdict.kind is VerdictKind.FINISHED
    states: list[ConditionState] = []
    if not finished:
        accepted = verdict.kind in (VerdictKind.COUNTS, VerdictKind.WAITING)
        states.append(ConditionState("Accepted", accepted, verdict.reason, verdict.message))
        if find(old.conditions, "Finished") is not None:
            states.append(ConditionState("Finished", False, "HolderReturned", "the holder renews its Lease again"))
    else:
        states.append(ConditionState("Finished", True, verdict.reason, verdict.message))
    suspends = task.spec.operation is Operation.SUSPEND
    applied_time, ready_time = old.applied_time, old.ready_time
    if verdict.kind is VerdictKind.COUNTS:
        if progress is not None:
            done = progress.stopped if suspends else progress.ready
            word = "suspended" if suspends else "ready"
            states += [
                _served("Applied", progress.applied, "Applied", "NotApplied", progress),
                _served("Ready", done, "Ready", "NotReady", progress, word),
            ]
            applied_time = applied_time or (since if progress.applied else None)
            ready_time = ready_time or (since if done else None)
        elif find(old.conditions, "Applied") is None:
            states.append(ConditionState("Ready", False, "NotReady", f"instance {verdict.instance} does not exist yet"))
    elif not finished:
        states.append(ConditionState("Ready", False, verdict.reason, verdict.message))
        if verdict.kind is VerdictKind.REFUSED:
            states.append(ConditionState(STALLED, True, verdict.reason, verdict.message))
    # A task that counts keeps its known progress until there is a newer one.
    only_while = (STALLED,) if verdict.kind is VerdictKind.COUNTS else ("Applied", "Ready", STALLED)
    known = old.conditions
    if verdict.kind is VerdictKind.LAPSED:
        # The condition's time is that of the loss, not that of an earlier refusal.
        known = [each for each in known if each.type != "Accepted" or each.reason == verdict.reason]
    conditions = updated(known, states, generation, now, only_while=only_while)
    instance = old.instance_name or verdict.instance if finished else verdict.instance
    return ApplicationTaskStatus(
        phase=_task_phase(verdict, progress, suspends),
        instance_name=instance,
        message=_task_message(verdict, progress, suspends),
        observed_generation=generation,
        applied_time=applied_time,
        ready_time=ready_time,
        conditions=conditions,
    )


def finished_since(task: ApplicationTask) -> float | None:
    """Since when the task is finished according to its status, in seconds since 1970; None if it is not."""
    condition = find(task.status.conditions, "Finished") if task.status else None
    return parse_seconds(condition.last_transition_time) if condition and condition.status == "True" else None


def _served(
    type_: str, now_holds: bool, reason: str, otherwise: str, progress: InstanceProgress, word: str = "applied"
) -> ConditionState:
    if now_holds:
        return ConditionState(type_, True, reason, f"instance {progress.instance} is {word}")
    if progress.applied and progress.reason and word != "suspended":
        otherwise = progress.reason
    problem = progress.problem or f"instance {progress.instance} is not {word} yet"
    return ConditionState(type_, False, otherwise, problem)


def _task_phase(verdict: Verdict, progress: InstanceProgress | None, suspends: bool) -> TaskPhase:
    match verdict.kind:
        case VerdictKind.WAITING:
            return TaskPhase.WAITING
        case VerdictKind.FINISHED:
            return TaskPhase.FINISHED
        case VerdictKind.REFUSED:
            return TaskPhase.REFUSED
        case VerdictKind.LAPSED:
            return TaskPhase.LAPSED
    if progress is None or not progress.applied:
        return TaskPhase.PENDING
    if suspends:
        return TaskPhase.READY if progress.stopped else TaskPhase.ACTIVE
    if progress.suspended:
        return TaskPhase.SUSPENDED
    return TaskPhase.READY if progress.ready else TaskPhase.ACTIVE


def _task_message(verdict: Verdict, progress: InstanceProgress | None, suspends: bool) -> str | None:
    if verdict.kind is not VerdictKind.COUNTS:
        return _short(verdict.message)
    notes = [] if verdict.reason == ACCEPTED else [verdict.message]
    if progress is None:
        return _short("; ".join([*notes, f"instance {verdict.instance} does not exist yet"]))
    done, word = (progress.stopped, "suspended") if suspends else (progress.ready, "ready")
    if progress.applied and done:
        return _short("; ".join(notes))
    lacks = word if progress.applied else "applied"
    return _short("; ".join([*notes, progress.problem or f"instance {progress.instance} is not {lacks} yet"]))


def instance_status(
    instance: ApplicationInstance,
    decision: Decision,
    applied: ConditionState,
    ready: ConditionState,
    objects: Iterable[ObjectReference],
    spec_hash: str | None,
    now: float,
    generation: int,
    suspended: ConditionState | None = None,
) -> ApplicationInstanceStatus:
    """The instance's status.

    `applied`, `ready` and `suspended` are its conditions; `suspended` is None if it was never suspended. `spec_hash`:
    the digest of the last applied rendering.
    """
    old = instance.status or ApplicationInstanceStatus()
    lingering = decision.release_time is not None
    if lingering:
        phase = InstancePhase.LINGERING
    elif not applied.holds:
        phase = InstancePhase.FAILED if applied.reason not in ("Waiting", "ChartPending") else InstancePhase.PENDING
    elif instance.spec.suspended:
        phase = InstancePhase.SUSPENDED
    else:
        phase = InstancePhase.READY if ready.holds else InstancePhase.APPLIED
    capped = ("SumBeyondBounds", "; ".join(decision.capped)) if decision.capped else None
    states = (
        applied,
        ready,
        *_stalled(phase, applied, ready, decision),
        *([suspended] if suspended else []),
        *from_first(old.conditions, "Capped", capped, ("WithinBounds", "no merged value is capped")),
        *fallback.fallback_conditions(old.conditions, decision.overdue, decision.fallback, decision.stands_in_for),
        *manual_conditions(instance),
    )
    return ApplicationInstanceStatus(
        phase=phase,
        message=_instance_message(instance, decision, applied, ready),
        observed_generation=generation,
        spec_hash=spec_hash,
        release_time=None if decision.release_time is None else format_seconds(decision.release_time),
        objects=list(objects),
        suspended_replicas=old.suspended_replicas,
        demands=demands(decision),
        conditions=updated(old.conditions, states, generation, now, only_while=(STALLED,)),
    )


def suspended_condition(
    instance: ApplicationInstance, decision: Decision, objects: Iterable[Mapping[str, Any] | None]
) -> ConditionState | None:
    """The condition Suspended of an instance with these live objects; None before it ever was suspended."""
    known = instance.status.conditions if instance.status else ()
    if not instance.spec.suspended:
        if find(known, "Suspended") is None:
            return None
        return ConditionState("Suspended", False, "NotSuspended", "no task suspends it")
    there = [each for each in objects if each is not None]
    left = [f"{each['kind']} {each['metadata']['name']} has {n} pods" for each in there if (n := pods_left(each))]
    whose = f"task {decision.suspender} suspends it" if decision.suspender else "spec.suspended is true"
    if left:
        return ConditionState("Suspended", False, "Stopping", f"{whose}: {', '.join(left)} left")
    resting = "".join(f"; HorizontalPodAutoscaler {each} is inactive until it resumes" for each in autoscalers(there))
    return ConditionState("Suspended", True, "Suspended", f"{whose}; its workloads are scaled to zero{resting}")


def _stalled(
    phase: InstancePhase, applied: ConditionState, ready: ConditionState, decision: Decision
) -> list[ConditionState]:
    """The condition Stalled, if waiting does not help: the objects are refused, or were not ready in time."""
    if not applied.holds and phase is InstancePhase.FAILED and applied.reason not in _PASSING:
        return [ConditionState(STALLED, True, applied.reason, applied.message)]
    if decision.overdue and not ready.holds and phase is not InstancePhase.SUSPENDED:
        return [ConditionState(STALLED, True, fallback.READY_TIMEOUT, ready.message)]
    return []


def _instance_message(
    instance: ApplicationInstance, decision: Decision, applied: ConditionState, ready: ConditionState
) -> str | None:
    parts = ["paused"] if decision.paused else []
    if not applied.holds:
        parts.append(applied.message)
    elif not ready.holds:
        parts.append(ready.message)
    if decision.release_time is not None:
        parts.append(f"released at {format_seconds(decision.release_time)} unless a demand arrives")
    elif is_held(instance) and not decision.demanded:
        parts.append("held without demand")
    parts += decision.capped
    parts += [f"stands in for {each}" for each in decision.stands_in_for]
    return _short("; ".join(parts))


def _short(message: str) -> str | None:
    """The message, shortened for a column; None if it is empty."""
    return cut(message, 512) or None


def demands(decision: Decision) -> Demands:
    """The number of tasks that the instance serves, and the first of them."""
    return Demands(count=len(decision.tasks), names=list(decision.tasks[:_NAMES_SHOWN]))


def template_status(
    old: ApplicationTemplateStatus,
    generation: int,
    findings: Findings,
    instances: int,
    now: float,
    manager: TemplateManager | None = None,
) -> ApplicationTemplateStatus:
    """The template's status, with the reason if it cannot be rendered."""
    if findings.problems:
        accepted = ConditionState("Accepted", False, TEMPLATE_INVALID, "; ".join(findings.problems))
    else:
        but = f", but {'; '.join(map(str, findings.remarks))}" if findings.remarks else ""
        accepted = ConditionState("Accepted", True, "Accepted", f"the template can be rendered{but}")
    return ApplicationTemplateStatus(
        observed_generation=generation,
        instances=instances,
        manager=manager,
        conditions=concluded(old.conditions, [accepted], generation, now, stalled=(TEMPLATE_INVALID,)),
    )


def difference(old: Json, new: Json) -> Json:
    """The JSON merge patch from `old` to `new`, on the first level: empty if they are equal."""
    patch: Json = {key: value for key, value in new.items() if old.get(key) != value}
    patch |= {key: None for key in old if key not in new}
    return patch
