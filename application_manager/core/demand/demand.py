"""The demand as a pure function of the live objects.

`demand` computes one namespace from its templates, tasks, instances with their status, the Leases of its holders and
the time. The result does not depend on the order of arrival. It consists of independent parts: each task claims an
instance by itself (`claims`), and `decide` (`deciding`) decides about one instance. The operator calls `decide` for
changed instances, with the indexes of its cache. `demand` calls it for all, with those of a snapshot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from application_manager.core.claims.claims import (
    Claim,
    InvalidTemplate,
    Refusal,
    TemplateState,
    all_instances,
    claim,
    template_of_all,
)
from application_manager.core.claims.operations import Verdict, VerdictKind, combined_verdict
from application_manager.core.demand.deciding import (
    decide,
    decide_without_limits,
    fallback_claims,
    has_baseline,
    request,
)
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.fallback import FALLEN_BACK, Fallback, fallback_of, with_fallback
from application_manager.core.demand.lingering import written_deadline
from application_manager.core.demand.places import Placement
from application_manager.core.demand.placing import limits
from application_manager.core.holders.leases import LeaseView
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate


@dataclass(frozen=True, slots=True)
class NamespaceOutcome:
    """The result for a whole namespace, by name.

    `instances`: those that exist or are to exist; `waiting`: those that do neither, although tasks demand them.
    """

    instances: dict[str, Decision]
    verdicts: dict[str, Verdict]
    next_change: float | None
    waiting: dict[str, Decision]


def demand(
    templates: Iterable[ApplicationTemplate | InvalidTemplate],
    tasks: Iterable[ApplicationTask],
    instances: Iterable[ApplicationInstance],
    leases: Mapping[str, LeaseView],
    now: float,
    limit: int | None = None,
) -> NamespaceOutcome:
    """The demand of one namespace, given all of its templates, tasks, instances and Leases (by holder).

    A holder without a Lease does not count as lost. `now` is in seconds since 1970; `limit`: the maximum number of
    instances in the namespace, None for no limit.
    """
    verdicts: dict[str, Verdict] = {}
    claims: list[Claim] = []
    by_name = {each.name: each for each in templates}
    for task in {each.name: each for each in tasks}.values():
        claimed = claim_or_verdict(by_name.get(task.spec.template_name), task)
        if isinstance(claimed, Claim):
            claims.append(claimed)
        else:
            verdicts[task.name] = claimed
    indexes = _Snapshot(by_name, {each.name: each for each in instances}, claims, leases, limit)
    found = {name: decide(name, indexes, now).decision for name in indexes.names(now)}
    decisions = {name: each for name, each in found.items() if each is not None}
    changes = [each.next_change for each in decisions.values() if each.next_change is not None]
    decided = dict(decisions)
    for name in {each.instance for each in claims if template_of_all(each.instance) is not None}:
        alone = decide(name, indexes, now).decision
        if alone is not None:
            decided[name] = alone
            changes += [] if alone.next_change is None else [alone.next_change]
    for each in claims:
        template = template_of_all(each.instance)
        of_template = [] if template is None else [name for name, of in decisions.items() if of.template == template]
        found_verdict = verdict_of(each, decided, of_template)
        if found_verdict is not None:
            verdicts[each.task.name] = found_verdict.verdict
    shown = {name: each for name, each in decisions.items() if each.demanded or indexes.instance(name) is not None}
    waiting = {name: each for name, each in decisions.items() if name not in shown}
    return NamespaceOutcome(shown, verdicts, min(changes, default=None), waiting)


class _Snapshot:
    """The indexes of one namespace, from a snapshot of its objects."""

    def __init__(
        self,
        templates: Mapping[str, ApplicationTemplate | InvalidTemplate],
        instances: Mapping[str, ApplicationInstance],
        claims: Iterable[Claim],
        leases: Mapping[str, LeaseView],
        limit: int | None,
    ) -> None:
        self._templates = templates
        self._instances = instances
        self._leases = leases
        self._limits = limits(templates.values(), limit)
        self._claims: dict[str, list[Claim]] = {}
        for each in claims:
            self._claims.setdefault(each.instance, []).append(each)
        self._fallbacks: dict[str, list[Fallback]] = {}
        self._placement: Placement | None = None

    def names(self, now: float) -> list[str]:
        """The instances that exist, or are demanded."""
        own = {each for each in self._claims if template_of_all(each) is None}
        always = {name for name, each in self._templates.items() if has_baseline(each)}
        taken_over = {
            each
            for to in self.fallback_templates()
            for fallback in self.fallbacks(to, now)
            for each in fallback.instances
        }
        return sorted(own | always | taken_over | self._instances.keys())

    def template(self, name: str) -> TemplateState:
        return self._templates.get(name)

    def instance(self, name: str) -> ApplicationInstance | None:
        return self._instances.get(name)

    def claims(self, instance: str, template: str | None = None) -> list[Claim]:
        of_all = self._claims.get(all_instances(template), []) if template is not None else []
        return [*self._claims.get(instance, []), *of_all]

    def deadline(self, instance: ApplicationInstance) -> float | None:
        return written_deadline(instance)

    def leases(self, claims: Iterable[Claim]) -> Mapping[str, LeaseView]:
        del claims
        return self._leases

    def fallback_templates(self) -> set[str]:
        return {other for each in self._templates.values() if (other := fallback_of(each)) is not None}

    def fallbacks(self, template: str, now: float) -> list[Fallback]:
        if template not in self._fallbacks:
            falling = {name for name, each in self._templates.items() if fallback_of(each) == template}
            of = [each for each in self._instances.values() if each.spec.template_name in falling]
            found = (fallback_claims(each, self, now) for each in of)
            self._fallbacks[template] = [each for each in found if each is not None]
        return self._fallbacks[template]

    def placement(self, name: str, unlimited: Decision | None, now: float) -> Placement | None:
        del name, unlimited
        if self._placement is None and self._limits:
            requests = {each: request(each, decide_without_limits(each, self, now), self) for each in self.names(now)}
            self._placement = Placement(self._limits).updated(requests, self._limits, now)
        return self._placement


@dataclass(frozen=True, slots=True)
class TaskVerdict:
    """The verdict of a task that has a claim, and the names of the instances that serve it.

    `generation`: the generation of the task that the verdict is based on.
    """

    verdict: Verdict
    serving: tuple[str, ...]
    generation: int


def verdict_of(claimed: Claim, decided: Mapping[str, Decision], instances: Iterable[str]) -> TaskVerdict | None:
    """The result for the task of a claim; None if its instance was not decided yet.

    `decided`: decisions by instance, and by the names that stand for all instances of a template; `instances`: the
    instances of the template, if the task is for all of them.
    """
    task, own = claimed.task.name, decided.get(claimed.instance)
    if own is None or task not in own.verdicts:
        return None
    if template_of_all(claimed.instance) is not None:
        found = {name: decided[name].verdicts for name in instances if name in decided and name != claimed.instance}
        parts = {name: verdicts[task] for name, verdicts in found.items() if task in verdicts}
        serving = tuple(name for name, each in parts.items() if each.kind is VerdictKind.COUNTS)
        generation = min(decided[name].generations[task] for name in (claimed.instance, *parts))
        return TaskVerdict(combined_verdict(claimed, parts, own.verdicts[task]), serving, generation)
    instead = own.fallback.instance_of(task) if own.fallback is not None else None
    other = decided.get(instead) if instead is not None else None
    verdict = with_fallback(own.verdicts[task], task, own.fallback, other.verdicts if other is not None else {})
    serves = instead if instead is not None and verdict.reason == FALLEN_BACK else claimed.instance
    known = own.generations[task]
    return TaskVerdict(verdict, (serves,), known if other is None else min(known, other.generations.get(task, known)))


def claim_or_verdict(template: TemplateState, task: ApplicationTask) -> Claim | Verdict:
    """The claim of the task, or its verdict if it has ended or is refused."""
    over = finished(task)
    if over is not None:
        return over
    claimed = claim(template, task)
    return refused(claimed) if isinstance(claimed, Refusal) else claimed


def finished(task: ApplicationTask) -> Verdict | None:
    """The verdict of a task that has ended; None if it has not."""
    if task.spec.end_time is not None:
        return Verdict(VerdictKind.FINISHED, "Ended", f"the demand ended at {task.spec.end_time}")
    if task.metadata.deletion_timestamp is not None:
        return Verdict(VerdictKind.FINISHED, "Deleted", "the task is being deleted")
    return None


def refused(refusal: Refusal) -> Verdict:
    """The verdict of a refused task."""
    return Verdict(VerdictKind.REFUSED, refusal.reason, refusal.message)
