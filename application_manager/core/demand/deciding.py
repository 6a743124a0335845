"""What should become of one instance: of the tasks that claim it, its status, the Leases and the time. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from application_manager.core.claims.claims import Claim, InvalidTemplate, Refused, template_of_all
from application_manager.core.claims.operations import Standing, Verdict, settle, waiting_for_any
from application_manager.core.conditions import find, holds
from application_manager.core.demand import byhand
from application_manager.core.demand.decisions import Decision, is_managed
from application_manager.core.demand.fallback import fallback, overdue
from application_manager.core.demand.lingering import linger_of, protected_until
from application_manager.core.demand.places import BASELINE_RANK
from application_manager.core.demand.placing import PREEMPTED
from application_manager.core.holders.lapses import live_claims
from application_manager.core.holders.leases import LeaseView
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate


def decide(
    name: str,
    template_name: str,
    *,
    template: ApplicationTemplate | InvalidTemplate | None,
    claims: Iterable[Claim],
    instance: ApplicationInstance | None,
    deadline: float | None,
    leases: Mapping[str, LeaseView],
    now: float,
    other: ApplicationTemplate | InvalidTemplate | None = None,
) -> Decision:
    """What should become of the instance, given the tasks that claim it.

    `other` is the template that its own one falls back to, if there is one of that name.
    `deadline` is the release time of the decision before this one, None where that was to keep the instance: a
    linger continues while there is no demand, and restarts after one.
    """
    ordered = sorted(claims, key=lambda each: precedence(each.task))
    paused = instance is not None and byhand.is_paused(instance)
    if instance is not None and not is_managed(instance):
        return _left_alone(instance, ordered)
    if isinstance(template, InvalidTemplate):  # its tasks are refused, and what runs stays until it is corrected
        key = instance.spec.key if instance else None
        return Decision(name, template_name, key, None, (), {}, None, None, paused)
    live, verdicts, changes = live_claims(ordered, template, leases, now)
    settled = settle(name, template, live, instance is not None)
    kept = instance.spec.key if instance else None
    key = next((each.key for each in live if each.task.name in settled.tasks[:1]), kept)  # all that deploy it agree
    wanted = settled.parameters is not None
    suspended: bool | None = settled.suspender is not None
    release_time = None
    if not wanted and instance is not None and not paused and not byhand.is_held(instance):
        linger = linger_of(instance, template).seconds  # from when we see that no demand is left
        release_time = max(now + linger if deadline is None else deadline, protected_until(instance, template))
        changes.append(release_time)
    late, change = overdue(instance, template, now) if instance is not None else ("", None)
    changes += [change] if change is not None else []
    served = [each for each in live if each.task.name in settled.tasks]
    if paused or template is None or (release_time is not None and instance is not None and instance.spec.suspended):
        suspended = None  # what lingers is not started again
    withheld = (
        paused
        and wanted
        and instance is not None
        and (
            instance.spec.parameters != settled.parameters or instance.spec.suspended != (settled.suspender is not None)
        )
    )
    return Decision(
        name=name,
        template=template_name,
        key=key,
        parameters=None if paused or settled.too_large else settled.parameters,
        tasks=settled.tasks,
        verdicts=verdicts | settled.verdicts,
        release_time=release_time,
        next_change=min((change for change in changes if change > now), default=None),
        paused=paused,
        withheld=withheld,
        capped=settled.capped,
        too_large=settled.too_large,
        baseline=settled.baseline,
        suspended=suspended,
        suspender=settled.suspender,
        rank=precedence(served[0].task) if served else BASELINE_RANK if settled.baseline else None,
        ran=any(_was_served(each.task) for each in served),
        overdue=late,
        fallback=fallback(name, template, other, served) if late and settled.suspender is None else None,
        stands_in_for=tuple(sorted({each.instead_of for each in served if each.instead_of})),
        borrowed=frozenset(each.task.name for each in ordered if each.instead_of),
    )


def _was_served(task: ApplicationTask) -> bool:
    """Whether the task's status says that its instance ran, or gave way to another."""
    conditions = task.status.conditions if task.status else ()
    accepted = find(conditions, "Accepted")
    applied = task.status is not None and task.status.applied_time is not None
    return applied or holds(conditions, "Applied") or (accepted is not None and accepted.reason == PREEMPTED)


def decide_for_all(
    name: str,
    *,
    template: ApplicationTemplate | InvalidTemplate | None,
    claims: Iterable[Claim],
    leases: Mapping[str, LeaseView],
    now: float,
) -> Decision:
    """The verdicts of tasks that mean all instances of a template, as far as these do not matter (see `gathered`).

    It makes nothing run; `name` is what `all_instances` gives.
    """
    ordered = sorted(claims, key=lambda each: precedence(each.task))
    usable = template if isinstance(template, ApplicationTemplate) else None
    live, verdicts, changes = live_claims(ordered, usable, leases, now)
    verdicts |= {each.task.name: waiting_for_any(each) for each in live}
    return Decision(
        name=name,
        template=template_of_all(name) or "",
        key=None,
        parameters=None,
        tasks=(),
        verdicts=verdicts,
        release_time=None,
        next_change=min((change for change in changes if change > now), default=None),
    )


def precedence(task: ApplicationTask) -> tuple[int, str, str]:
    """The order of tasks: priority descending, then creation, then name; never times that the sender claims."""
    return (-task.spec.priority, task.metadata.creation_timestamp, task.name)


def _left_alone(instance: ApplicationInstance, claims: list[Claim]) -> Decision:
    message = (
        f"ApplicationInstance {instance.name} was made by a person and is left alone: "
        "delete it, or give it another name, so that tasks can be served"
    )
    refused = Verdict(Standing.REFUSED, Refused.INSTANCE_NOT_MANAGED, message)
    verdicts = {each.task.name: refused for each in claims}
    spec = instance.spec
    paused = byhand.is_paused(instance)
    return Decision(instance.name, spec.template, spec.key, None, (), verdicts, None, None, paused)
