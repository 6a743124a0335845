"""Demand: what should run, as a pure function of what is live.

`demand` looks at one namespace: its templates, tasks, instances with their status, the Leases of its holders and the
time. The result does not depend on the order in which anything arrived. It falls into independent parts: each task
claims an instance by itself (`claims`), and `decide` looks at one instance and the tasks that claim it. The operator
calls just these parts for what changed; `demand` is their sum. Only where there are limits, the parts of a namespace
are looked at together (`places`), and what is beyond a limit waits or goes (`placing`); and the tasks of an instance
that does not become ready claim one of another template (`fallback`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from application_manager.core.claims.claims import (
    Claim,
    InvalidTemplate,
    Refusal,
    all_instances,
    claim,
    template_of_all,
)
from application_manager.core.claims.operations import Standing, Verdict, gathered
from application_manager.core.claims.parameters import baseline
from application_manager.core.demand.deciding import decide, decide_for_all
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.fallback import fallback_of, turned
from application_manager.core.demand.lingering import written_deadline
from application_manager.core.demand.places import places
from application_manager.core.demand.placing import candidate, limits, placed
from application_manager.core.holders.leases import LeaseView
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate


@dataclass(frozen=True, slots=True)
class Outcome:
    """What should become of a whole namespace, by name.

    Attributes:
        instances: those that exist or should.
        waiting: those that do neither, though there are tasks for them.
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
) -> Outcome:
    """What should run in one namespace.

    Args:
        templates: all of the namespace, as all else.
        tasks: those being deleted count no more.
        instances: with their status, which holds the deadline of a linger.
        leases: by holder; a holder that is missing is not lost.
        now: seconds since 1970.
        limit: how many instances the namespace may have; None: any number.
    """
    by_name: dict[str, ApplicationTemplate | InvalidTemplate] = {each.name: each for each in templates}
    existing = {each.name: each for each in instances}
    claimed: dict[str, list[Claim]] = {}
    verdicts: dict[str, Verdict] = {}
    for task in {each.name: each for each in tasks}.values():
        verdict = claim_or_verdict(by_name.get(task.spec.template), task)
        if isinstance(verdict, Claim):
            claimed.setdefault(verdict.instance, []).append(verdict)
        else:
            verdicts[task.name] = verdict
    to_all = {name: claimed.pop(name) for name in list(claimed) if template_of_all(name)}
    always = {name for name, each in by_name.items() if has_baseline(each)}

    def decided(name: str, template: str, claims: list[Claim]) -> Decision:
        instance, of = existing.get(name), by_name.get(template)
        return decide(
            name,
            template,
            template=of,
            claims=[*claims, *to_all.get(all_instances(template), [])],
            instance=instance,
            deadline=written_deadline(instance) if instance else None,
            leases=leases,
            now=now,
            other=by_name.get(fallback_of(of) or ""),
        )

    turns = {
        name: decided(name, each.spec.template, claimed.get(name, [])).fallback
        for name, each in existing.items()
        if fallback_of(by_name.get(each.spec.template)) is not None
    }
    for each in (claim_ for turn in turns.values() if turn is not None for claim_ in turn.claims):
        claimed.setdefault(each.instance, []).append(each)
    decisions: dict[str, Decision] = {}
    for name in sorted(claimed.keys() | existing.keys() | always):
        instance, claims = existing.get(name), claimed.get(name, [])
        template = instance.spec.template if instance else claims[0].template if claims else name
        decisions[name] = replace(decided(name, template, claims), fallback=turns.get(name))
    bounds = limits(by_name.values(), limit)
    if bounds:
        asking = (candidate(each, existing.get(name), by_name.get(each.template)) for name, each in decisions.items())
        given = places((each for each in asking if each is not None), bounds, now)
        decisions = {
            name: placed(each, given.get(name), exists=name in existing, now=now) for name, each in decisions.items()
        }
    for settled in decisions.values():
        own = {name: each for name, each in settled.verdicts.items() if name not in settled.borrowed}
        verdicts |= {name: _turned(each, name, settled, decisions) for name, each in own.items()}
    changes = [each.next_change for each in decisions.values() if each.next_change is not None]
    for name, claims in to_all.items():
        of = template_of_all(name) or ""
        alone = decide_for_all(name, template=by_name.get(of), claims=claims, leases=leases, now=now)
        for each in claims:
            parts = {
                decision.name: decision.verdicts[each.task.name]
                for decision in decisions.values()
                if decision.template == of and each.task.name in decision.verdicts
            }
            verdicts[each.task.name] = gathered(each, parts, alone.verdicts[each.task.name])
        if alone.next_change is not None:
            changes.append(alone.next_change)
    shown = {name: each for name, each in decisions.items() if each.wanted or name in existing}
    waiting = {name: each for name, each in decisions.items() if name not in shown}
    return Outcome(shown, verdicts, min(changes, default=None), waiting)


def _turned(verdict: Verdict, task: str, settled: Decision, decisions: Mapping[str, Decision]) -> Verdict:
    other = decisions.get(settled.fallback.instance_of(task) or "") if settled.fallback is not None else None
    return turned(verdict, task, settled.fallback, other.verdicts if other is not None else {})


def has_baseline(template: ApplicationTemplate | InvalidTemplate | None) -> bool:
    """Whether the template demands its instance, which has its name, by itself."""
    return isinstance(template, ApplicationTemplate) and baseline(template) is not None


def claim_or_verdict(template: ApplicationTemplate | InvalidTemplate | None, task: ApplicationTask) -> Claim | Verdict:
    """What the task claims, or its verdict where it claims nothing, because it has ended or is refused."""
    over = finished(task)
    if over is not None:
        return over
    claimed = claim(template, task)
    return refused(claimed) if isinstance(claimed, Refusal) else claimed


def finished(task: ApplicationTask) -> Verdict | None:
    """The verdict of a task that has ended; None where it has not."""
    if task.spec.end_time is not None:
        return Verdict(Standing.FINISHED, "Ended", f"the demand ended at {task.spec.end_time}")
    if task.metadata.deletion_timestamp is not None:
        return Verdict(Standing.FINISHED, "Deleted", "the task is being deleted")
    return None


def refused(refusal: Refusal) -> Verdict:
    """The verdict of a task that is refused."""
    return Verdict(Standing.REFUSED, refusal.reason, refusal.message)
