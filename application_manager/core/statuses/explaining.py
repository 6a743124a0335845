"""Explains why a task is served or not, and the state of an instance: one chain from the event to the pods. Pure.

From the statuses it reads only the facts that the manager alone can know (lost holders, deadlines): it computes the
demand from the live objects, with the same functions. So an explanation is also correct while no manager runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from application_manager.core.claims import values
from application_manager.core.claims.claims import InvalidTemplate, TemplateState, claim, template_of_all
from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.conditions import find
from application_manager.core.demand.deciding import precedence
from application_manager.core.demand.decisions import Decision, is_managed
from application_manager.core.demand.demand import NamespaceOutcome, demand
from application_manager.core.demand.placing import LIMIT_REACHED, PREEMPTED
from application_manager.core.health.pods import trouble
from application_manager.core.health.readiness import not_ready
from application_manager.core.holders.leases import HOLDER_LOST, LeaseView
from application_manager.core.statuses.explanation import (
    ExplainedContribution,
    ExplainedInstance,
    ExplainedObject,
    ExplainedParameter,
    ExplainedPod,
    ExplainedTask,
    ExplainedTemplate,
    Explanation,
)
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate
from wayside.api.operation import Operation
from wayside.api.parameter import Merge
from wayside.times import parse_seconds

Object = Mapping[str, Any]

_LATER = {
    Merge.MAX: "a larger value counts",
    Merge.MIN: "a smaller value counts",
    Merge.HIGHEST_PRIORITY: "a task of higher priority counts",
    Merge.ALL: "another task gives false",
    Merge.ANY: "another task gives true",
}
"""Why a value has no effect."""

_BELOW = "a Reconfigure task overrides it"


@dataclass(frozen=True, slots=True)
class NamespaceSnapshot:
    """The live objects of one namespace, because a place depends on all of them.

    `objects`: those in the instance's status, None if one is missing; `pods`: those with its label; `leases`: by
    holder.
    """

    templates: Sequence[ApplicationTemplate | InvalidTemplate]
    tasks: Sequence[ApplicationTask]
    instances: Sequence[ApplicationInstance]
    objects: Mapping[tuple[str, str, str], Object | None] = field(default_factory=dict)
    pods: Sequence[Object] = ()
    leases: Mapping[str, Object] = field(default_factory=dict)


def serving(snapshot: NamespaceSnapshot, task: ApplicationTask, now: float) -> str | None:
    """The name of the instance that serves the task, or that it claims; None if there is none, or it claims all.

    `now` is in seconds since 1970.
    """
    template = next((each for each in snapshot.templates if each.name == task.spec.template_name), None)
    claimed: str | None = getattr(claim(template, task), "instance", None)
    if claimed is not None and template_of_all(claimed) is not None:
        return None
    verdict, written = _outcome(snapshot, now).verdicts[task.name], task.status.instance_name if task.status else None
    if verdict.kind is VerdictKind.FINISHED:
        return written or claimed
    return verdict.instance or claimed or written


def _outcome(snapshot: NamespaceSnapshot, now: float) -> NamespaceOutcome:
    """The demand. Only the manager knows its limits, so a waiting task keeps the verdict of its status."""
    outcome = demand(snapshot.templates, snapshot.tasks, snapshot.instances, _written_leases(snapshot.tasks), now)
    limited = {each.name: verdict for each in snapshot.tasks if (verdict := _written_limit(each)) is not None}
    verdicts = {
        name: limited.get(name, verdict) if verdict.kind is VerdictKind.COUNTS else verdict
        for name, verdict in outcome.verdicts.items()
    }
    return replace(outcome, verdicts=verdicts)


def _written_limit(task: ApplicationTask) -> Verdict | None:
    """The verdict of a task without a place, from its status; None if it has a place, or its status is outdated."""
    accepted = find(task.status.conditions, "Accepted") if task.status else None
    if accepted is None or accepted.reason not in (LIMIT_REACHED, PREEMPTED):
        return None
    if task.status is None or task.status.observed_generation < task.metadata.generation:
        return None
    return Verdict(VerdictKind.WAITING, accepted.reason, accepted.message)


def explanation_of(snapshot: NamespaceSnapshot, *, task: str | None, instance: str | None, now: float) -> Explanation:
    """The chain of a task or, if `task` is None, of an instance; these are names of objects in `snapshot`.

    `instance`: the one that serves the task, None if none does; `now` is in seconds since 1970.
    """
    outcome = _outcome(snapshot, now)
    decision = (outcome.instances | outcome.waiting).get(instance) if instance else None
    subject = next((each for each in snapshot.tasks if each.name == task), None)
    existing = next((each for each in snapshot.instances if each.name == instance), None)
    of = (
        subject.spec.template_name
        if subject
        else decision.template
        if decision
        else existing.spec.template_name
        if existing
        else ""
    )
    template = next((each for each in snapshot.templates if each.name == of), None)
    served = next((each for each in snapshot.templates if decision and each.name == decision.template), template)
    others = [
        each
        for each in sorted(snapshot.tasks, key=precedence)
        if each.name in (decision.verdicts if decision else ()) or each is subject or _names(each, instance)
    ]
    explained = [_task(each, outcome.verdicts[each.name], snapshot.leases, now) for each in others]
    return Explanation(
        task=next((each for each in explained if each.name == task), None),
        template=_template(of, template),
        instance=_instance(instance, existing, decision),
        tasks=explained,
        parameters=_parameters(served, others, decision, existing),
        objects=[_object(key, live) for key, live in sorted(snapshot.objects.items())],
        pods=[_pod(each) for each in sorted(snapshot.pods, key=lambda each: str(each["metadata"]["name"]))],
    )


def _names(task: ApplicationTask, instance: str | None) -> bool:
    """Whether the instance served a task that has finished."""
    return instance is not None and task.status is not None and task.status.instance_name == instance


def _written_leases(tasks: Sequence[ApplicationTask]) -> dict[str, LeaseView]:
    """A view of each holder. The tasks' statuses show lost holders: a single read does not show renewals."""
    holders = {each.spec.requester.holder for each in tasks}
    return {each: LeaseView(0.0, renewed=False) for each in holders if each is not None}


def _task(task: ApplicationTask, verdict: Verdict, leases: Mapping[str, Object], now: float) -> ExplainedTask:
    status, event, holder = task.status, task.spec.event, task.spec.requester.holder
    conditions = status.conditions if status else []
    accepted = find(conditions, "Accepted")
    behind = status is None or status.observed_generation < task.metadata.generation
    return ExplainedTask(
        name=task.name,
        phase=str(status.phase.value) if status and status.phase else None,
        verdict=str(verdict.kind.value),
        reason=verdict.reason,
        message=verdict.message,
        operation=str(task.spec.operation.value),
        priority=task.spec.priority,
        created=task.metadata.creation_timestamp or None,
        detector=task.spec.requester.detector_name,
        holder=holder,
        lease_age_seconds=_lease_age(leases.get(holder), now) if holder else None,
        holder_is_lost=accepted is not None and accepted.reason == HOLDER_LOST,
        rule=event.rule if event else None,
        subject=event.subject if event else None,
        event=event.to_json() if event else None,
        parameters=dict(task.spec.parameters),
        conditions=[each.to_json() for each in conditions],
        unprocessed=behind,
    )


def _lease_age(lease: Object | None, now: float) -> float | None:
    renewed = (lease or {}).get("spec", {}).get("renewTime")
    try:
        return round(now - parse_seconds(renewed), 1) if renewed else None
    except ValueError:
        return None


def _template(name: str, template: TemplateState) -> ExplainedTemplate:
    if template is None:
        return ExplainedTemplate(name=name, problem="does not exist")
    if isinstance(template, InvalidTemplate):
        return ExplainedTemplate(name=name, problem=template.problem)
    accepted = find(template.status.conditions, "Accepted") if template.status else None
    problem = accepted.message if accepted is not None and accepted.status == "False" else None
    return ExplainedTemplate(name=name, problem=problem, key=template.spec.key)


def _instance(
    name: str | None, existing: ApplicationInstance | None, decision: Decision | None
) -> ExplainedInstance | None:
    if name is None or (existing is None and decision is None):
        return None
    status = existing.status if existing else None
    return ExplainedInstance(
        name=name,
        template=decision.template if decision else existing.spec.template_name if existing else None,
        exists=existing is not None,
        managed=existing is None or is_managed(existing),
        key=decision.key if decision else existing.spec.key if existing else None,
        phase=str(status.phase.value) if status and status.phase else None,
        release_time=status.release_time if status else None,
        conditions=[each.to_json() for each in status.conditions] if status else [],
    )


def _parameters(
    template: TemplateState,
    tasks: Sequence[ApplicationTask],
    decision: Decision | None,
    existing: ApplicationInstance | None,
) -> list[ExplainedParameter]:
    """Each parameter with its value and the contributions of tasks, including those that do not count."""
    if not isinstance(template, ApplicationTemplate) or decision is None:
        return []
    merged = decision.parameters if decision.parameters is not None else existing.spec.parameters if existing else {}
    counting = set(decision.tasks)
    changing = {
        each.name
        for each in tasks
        if each.spec.operation is Operation.RECONFIGURE
        and each.name in decision.verdicts
        and decision.verdicts[each.name].kind is VerdictKind.COUNTS
    }
    # A Suspend task gives parameters only to identify its instance.
    speaking = [each for each in tasks if each.spec.operation is not Operation.SUSPEND and each.spec.end_time is None]
    always = template.spec.baseline.parameters if template.spec.baseline else {}
    result = []
    for name, parameter in sorted(template.spec.parameters.items()):
        value = merged.get(name)
        layered = any(each.name in changing and each.spec.parameters.get(name) is not None for each in tasks)
        contributions = [
            ExplainedContribution(task=each.name, value=each.spec.parameters[name], effect="outbid", why=_BELOW)
            if layered and each.name in counting
            else _contribution(
                each, each.spec.parameters[name], value, parameter.merge, counts=each.name in counting | changing
            )
            for each in speaking
            if each.spec.parameters.get(name) is not None
        ]
        source = "tasks" if any(each.effect != "none" for each in contributions) else "none"
        if source == "none" and value is not None:
            is_default = values.canonical(value) == values.canonical(parameter.default)
            source = (
                "baseline"
                if name in always
                else "default"
                if parameter.default is not None and is_default
                else "earlier"
            )
        result.append(
            ExplainedParameter(
                name=name,
                merge=str(parameter.merge.value),
                value=value,
                source=source,
                note=next((each[len(name) + 2 :] for each in decision.capped if each.startswith(f"{name}: ")), None),
                contributions=contributions,
            )
        )
    return result


def _contribution(
    task: ApplicationTask, given: Any, value: Any, merge: Merge, *, counts: bool
) -> ExplainedContribution:
    if not counts:
        return ExplainedContribution(task=task.name, value=given, effect="none", why="the task does not count")
    if values.canonical(values.normal(given)) == values.canonical(value):
        return ExplainedContribution(task=task.name, value=given, effect="decides")
    if merge in _LATER:
        return ExplainedContribution(task=task.name, value=given, effect="outbid", why=_LATER[merge])
    return ExplainedContribution(task=task.name, value=given, effect="part")


def _object(key: tuple[str, str, str], live: Object | None) -> ExplainedObject:
    problem = "does not exist" if live is None else not_ready(live)
    return ExplainedObject(api_version=key[0], kind=key[1], name=key[2], ready=problem is None, problem=problem)


def _pod(pod: Object) -> ExplainedPod:
    problem, idle = trouble(pod), not_ready({**pod, "kind": "Pod"})
    status = pod.get("status") or {}
    return ExplainedPod(
        name=str(pod["metadata"]["name"]),
        phase=str(status.get("phase", "Pending")),
        node=(pod.get("spec") or {}).get("nodeName"),
        ready=idle is None,
        problem=problem.text if problem else None,
    )
