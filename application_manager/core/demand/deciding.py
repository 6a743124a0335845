"""Decides about one instance, from indexes of its namespace and the time. Pure.

`decide` is the only function that decides: the operator calls it with the indexes of its cache, and `demand` with those
of a snapshot. It changes nothing.

Without limits, a decision follows from the tasks that claim the instance, its status and the Leases of their holders.
If the template of an instance that is not ready falls back to this template, its tasks claim this instance too. Limits
are applied last: all instances of the namespace compete for places.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

from application_manager.core.claims.claims import Claim, InvalidTemplate, RefusalReason, TemplateState, template_of_all
from application_manager.core.claims.operations import Verdict, VerdictKind, combine, waiting_for_any
from application_manager.core.claims.parameters import baseline
from application_manager.core.conditions import find, holds
from application_manager.core.demand.decisions import Decision, is_managed
from application_manager.core.demand.fallback import Fallback, fallback, fallback_of, overdue
from application_manager.core.demand.lingering import is_held, is_paused, linger_of, protected_until
from application_manager.core.demand.places import BASELINE_RANK, Placement, PlaceRequest
from application_manager.core.demand.placing import PREEMPTED, candidate, placed
from application_manager.core.holders.leases import LeaseView, live_claims
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate


class Indexes(Protocol):
    """The data of one namespace for decisions. Names are those of its objects."""

    def template(self, name: str) -> TemplateState:
        """The template, even if it is not valid."""

    def instance(self, name: str) -> ApplicationInstance | None:
        """The instance."""

    def claims(self, instance: str, template: str | None = None) -> list[Claim]:
        """The claims of tasks on an instance; with its template, also the claims on all instances of the template."""

    def deadline(self, instance: ApplicationInstance) -> float | None:
        """The release time decided before, in seconds since 1970; None if the instance was to stay."""

    def leases(self, claims: Iterable[Claim]) -> Mapping[str, LeaseView]:
        """The Leases of the holders of these claims, by holder; a missing one does not count as lost."""

    def fallback_templates(self) -> Iterable[str]:
        """The templates to which others fall back."""

    def fallbacks(self, template: str, now: float) -> Iterable[Fallback]:
        """`fallback_claims` of each instance whose template falls back to this one."""

    def placement(self, name: str, unlimited: Decision | None, now: float) -> Placement | None:
        """The placement, given the decision about this instance without limits; None if there are no limits."""


@dataclass(frozen=True, slots=True)
class Decided:
    """The result of `decide`.

    Attributes:
        decision: the decision; None if the instance neither exists nor is demanded.
        unlimited: the decision without limits.
        placement: the placement of the namespace; None if there are no limits.
    """

    decision: Decision | None
    unlimited: Decision | None = None
    placement: Placement | None = None


def decide(name: str, indexes: Indexes, now: float) -> Decided:
    """The decision about an instance or, with the name that stands for all instances of a template, about their tasks.

    `now` is in seconds since 1970.
    """
    if template_of_all(name) is not None:
        return Decided(_decide_for_all(name, indexes, now))
    unlimited = decide_without_limits(name, indexes, now)
    placement = indexes.placement(name, unlimited, now)
    if unlimited is None or placement is None:
        return Decided(unlimited, unlimited, placement)
    exists = indexes.instance(name) is not None
    return Decided(placed(unlimited, placement.granted.get(name), exists=exists, now=now), unlimited, placement)


def decide_without_limits(name: str, indexes: Indexes, now: float) -> Decision | None:
    """The decision without limits; None if the instance neither exists nor is demanded."""
    instance, named = indexes.instance(name), indexes.claims(name)
    template = _template_of(name, instance, named, indexes, now)
    borrowed = _borrowed(name, template, indexes, now)
    if instance is None and not named and not borrowed and not has_baseline(indexes.template(name)):
        return None
    own = indexes.claims(name, template)
    decision = _decide_one(name, template, [*own, *borrowed], indexes, now)
    if borrowed and decision.overdue:  # a fallback instance has no further fallback for these tasks
        return replace(decision, fallback=_decide_one(name, template, own, indexes, now).fallback)
    return decision


def request(name: str, unlimited: Decision | None, indexes: Indexes, *, being_created: bool = False) -> PlaceRequest:
    """The instance's request for a place; `being_created`: it may have been created at the API server already."""
    if unlimited is None:
        return PlaceRequest(None, None)
    template = indexes.template(unlimited.template)
    needed = candidate(unlimited, indexes.instance(name), template, being_created=being_created)
    return PlaceRequest(needed, unlimited.next_change)


def fallback_claims(instance: ApplicationInstance, indexes: Indexes, now: float) -> Fallback | None:
    """The fallback of an instance's tasks while it is overdue; None if there is none."""
    of = instance.spec.template_name
    if not overdue(instance, indexes.template(of), now)[0]:
        return None
    return _decide_one(instance.name, of, indexes.claims(instance.name, of), indexes, now).fallback


def has_baseline(template: TemplateState) -> bool:
    """Whether the template itself demands the instance with its name."""
    return isinstance(template, ApplicationTemplate) and baseline(template) is not None


def _template_of(
    name: str, instance: ApplicationInstance | None, claims: list[Claim], indexes: Indexes, now: float
) -> str:
    if instance is not None:
        return instance.spec.template_name
    if claims:
        return claims[0].template
    named = (each for each in indexes.fallback_templates() if name == each or name.startswith(f"{each}-"))
    return next((each for each in named if _borrowed(name, each, indexes, now)), name)


def _borrowed(name: str, template: str, indexes: Indexes, now: float) -> list[Claim]:
    """The claims on an instance by tasks whose own instance is not ready."""
    return [
        each for fallback_ in indexes.fallbacks(template, now) for each in fallback_.claims if each.instance == name
    ]


def _decide_one(name: str, template_name: str, claims: Iterable[Claim], indexes: Indexes, now: float) -> Decision:
    """The decision about an instance, given the tasks that claim it."""
    ordered = sorted(claims, key=lambda each: precedence(each.task))
    template, instance = indexes.template(template_name), indexes.instance(name)
    paused = instance is not None and is_paused(instance)
    if instance is not None and not is_managed(instance):
        return _left_alone(instance, ordered)
    if isinstance(template, InvalidTemplate):  # its tasks are refused; the objects stay as they are
        key = instance.spec.key if instance else None
        return Decision(name, template_name, key, paused=paused)
    live, verdicts, changes = live_claims(ordered, template, indexes.leases(ordered), now)
    combined = combine(name, template, live, instance is not None)
    kept = instance.spec.key if instance else None
    key = next((each.key for each in live if each.task.name in combined.tasks[:1]), kept)  # all that deploy it agree
    wanted = combined.parameters is not None
    suspended: bool | None = combined.suspender is not None
    release_time = None
    if not wanted and instance is not None and not paused and not is_held(instance):
        linger = linger_of(instance, template).seconds  # from the time at which we see that no demand is left
        deadline = indexes.deadline(instance)  # of the current linger; it restarts after a demand
        release_time = max(now + linger if deadline is None else deadline, protected_until(instance, template))
        changes.append(release_time)
    other = indexes.template(fallback_of(template) or "")
    late, change = overdue(instance, template, now) if instance is not None else ("", None)
    changes += [change] if change is not None else []
    served = [each for each in live if each.task.name in combined.tasks]
    if paused or template is None or (release_time is not None and instance is not None and instance.spec.suspended):
        suspended = None  # a lingering instance is not started again
    demanded = (combined.parameters, combined.suspender is not None)
    withheld = (
        paused and wanted and instance is not None and (instance.spec.parameters, instance.spec.suspended) != demanded
    )
    return Decision(
        name=name,
        template=template_name,
        key=key,
        parameters=None if paused or combined.too_large else combined.parameters,
        tasks=combined.tasks,
        verdicts=verdicts | combined.verdicts,
        generations=_generations(ordered),
        release_time=release_time,
        next_change=min((change for change in changes if change > now), default=None),
        paused=paused,
        withheld=withheld,
        capped=combined.capped,
        too_large=combined.too_large,
        baseline=combined.baseline,
        suspended=suspended,
        suspender=combined.suspender,
        rank=precedence(served[0].task) if served else BASELINE_RANK if combined.baseline else None,
        ran=any(_was_served(each.task) for each in served),
        overdue=late,
        fallback=fallback(name, template, other, served) if late and combined.suspender is None else None,
        stands_in_for=tuple(sorted({each.instead_of for each in served if each.instead_of})),
        borrowed=frozenset(each.task.name for each in ordered if each.instead_of),
    )


def _was_served(task: ApplicationTask) -> bool:
    """Whether the task's status shows that its instance ran, or was preempted."""
    conditions = task.status.conditions if task.status else ()
    accepted = find(conditions, "Accepted")
    applied = task.status is not None and task.status.applied_time is not None
    return applied or holds(conditions, "Applied") or (accepted is not None and accepted.reason == PREEMPTED)


def _decide_for_all(name: str, indexes: Indexes, now: float) -> Decision | None:
    """The verdicts of tasks for all instances of a template, for the case that it has none (see `combined_verdict`).

    It demands no instance; `name` is the result of `all_instances`. None if there are no such tasks.
    """
    template = indexes.template(template_of_all(name) or "")
    ordered = sorted(indexes.claims(name), key=lambda each: precedence(each.task))
    if not ordered:
        return None
    usable = template if isinstance(template, ApplicationTemplate) else None
    live, verdicts, changes = live_claims(ordered, usable, indexes.leases(ordered), now)
    verdicts |= {each.task.name: waiting_for_any(each) for each in live}
    change = min((each for each in changes if each > now), default=None)
    template_name = template_of_all(name) or ""
    return Decision(name, template_name, verdicts=verdicts, generations=_generations(ordered), next_change=change)


def _generations(claims: Iterable[Claim]) -> dict[str, int]:
    return {each.task.name: each.task.metadata.generation for each in claims}


def precedence(task: ApplicationTask) -> tuple[int, str, str]:
    """The order of tasks: priority descending, then creation time, then name; never times that the sender claims."""
    return (-task.spec.priority, task.metadata.creation_timestamp, task.name)


def _left_alone(instance: ApplicationInstance, claims: list[Claim]) -> Decision:
    message = (
        f"ApplicationInstance {instance.name} was created by a person, so the manager does not change it: delete it, "
        "or create it again under another name"
    )
    refused = Verdict(VerdictKind.REFUSED, RefusalReason.INSTANCE_NOT_MANAGED, message)
    verdicts = {each.task.name: refused for each in claims}
    spec = instance.spec
    return Decision(
        instance.name,
        spec.template_name,
        spec.key,
        verdicts=verdicts,
        generations=_generations(claims),
        paused=is_paused(instance),
    )
