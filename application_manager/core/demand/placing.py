"""Applies limits: the request of a decision, and its result once places are assigned. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from application_manager.core.claims.claims import InvalidTemplate, TemplateState
from application_manager.core.claims.operations import NOTHING_RUNS, Verdict, VerdictKind
from application_manager.core.demand.decisions import Decision, is_managed
from application_manager.core.demand.lingering import is_held, protected_until
from application_manager.core.demand.places import GrantedPlace, Limits, PlaceCandidate
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.times import format_seconds

LIMIT_REACHED = "LimitReached"
"""Reason of the condition Accepted of a task whose instance waits for a place."""

PREEMPTED = "Preempted"
"""Reason of the condition Accepted of a task whose instance ran, until one of higher priority got its place."""


def limits(templates: Iterable[ApplicationTemplate | InvalidTemplate], namespace: int | None) -> Limits:
    """The limits of one namespace; `namespace` is the limit of all its instances."""
    own = {
        each.name: each.spec.max_instances
        for each in templates
        if isinstance(each, ApplicationTemplate) and each.spec.max_instances is not None
    }
    return Limits(own, namespace)


def candidate(
    decision: Decision,
    instance: ApplicationInstance | None,
    template: TemplateState,
    *,
    being_created: bool = False,
) -> PlaceCandidate | None:
    """The candidate of the decision; None if it needs no place, or the instance is a person's."""
    if instance is not None and not is_managed(instance):
        return None
    if instance is None and decision.rank is None:
        return None
    kept = instance is not None and (
        decision.paused or is_held(instance) or (not decision.demanded and decision.release_time is None)
    )
    return PlaceCandidate(
        name=decision.name,
        template=decision.template,
        rank=decision.rank,
        exists=instance is not None or being_created,
        leaving=instance is not None and instance.metadata.deletion_timestamp is not None,
        kept=kept,
        protected_until=protected_until(instance, template) if instance is not None else 0.0,
        deadline=decision.release_time,
        ran=instance is not None or decision.ran,
    )


def placed(decision: Decision, place: GrantedPlace | None, *, exists: bool, now: float) -> Decision:
    """The decision, given the place of its instance; None: no limit applies."""
    if place is None:
        return decision
    if place.starts:
        return _marked(decision, f", and preempts {place.preempts}") if place.preempts else decision
    if exists and place.granted:
        return decision
    reason, message = _why(decision, place)
    verdicts = {
        name: _waiting(decision, each, reason, message) if each.kind is VerdictKind.COUNTS else each
        for name, each in decision.verdicts.items()
    }
    changes = [each for each in (decision.next_change, place.next_change) if each is not None and each > now]
    return replace(
        decision,
        parameters=None,
        tasks=(),
        baseline=False,
        suspended=None,
        suspender=None,
        capped=(),
        fallback=None,
        stands_in_for=(),
        verdicts=verdicts,
        release_time=now if exists else None,
        next_change=min(changes, default=None),
        yields=message if exists else "",
    )


def _why(decision: Decision, place: GrantedPlace) -> tuple[str, str]:
    if place.granted:
        instead = f", and preempts {place.preempts}" if place.preempts else ""
        return LIMIT_REACHED, f"instance {decision.name} starts once {place.awaits} is deleted{instead}"
    if decision.rank is None:
        return LIMIT_REACHED, f"{place.limit}, and no task demands the instance {decision.name}"
    remedy = "raise the limit, or wait until another instance ends"
    if place.yields_to:
        message = f"instance {decision.name} was preempted by {place.yields_to}, since {place.limit}: {remedy}"
        return PREEMPTED, message
    if place.outbid_from is not None and place.outbid_from <= -decision.rank[0] and place.next_change is not None:
        remedy = f"it can start after {format_seconds(place.next_change)}, when the minUptime of another instance ends"
    elif place.outbid_from is not None:
        remedy = f"{remedy}, or set a priority of {place.outbid_from} or more"
    return LIMIT_REACHED, f"instance {decision.name} waits, since {place.limit}: {remedy}"


def _waiting(decision: Decision, each: Verdict, reason: str, message: str) -> Verdict:
    if each.acts:
        what = f"instance {decision.name} does not run ({reason}): the task takes effect once it runs"
        return Verdict(VerdictKind.WAITING, NOTHING_RUNS, what)
    return Verdict(VerdictKind.WAITING, reason, message)


def _marked(decision: Decision, words: str) -> Decision:
    verdicts = {
        name: replace(each, message=each.message + words) if each.kind is VerdictKind.COUNTS and not each.acts else each
        for name, each in decision.verdicts.items()
    }
    return replace(decision, verdicts=verdicts)
