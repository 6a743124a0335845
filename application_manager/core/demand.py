"""Demand: what should run, as a pure function of what is live.

`demand` looks at one namespace: its templates, tasks, instances with their status, the Leases of its holders and the
time. The result does not depend on the order in which anything arrived. It falls into independent parts: each task
claims an instance by itself (`claims`), and `decide` looks at one instance and the tasks that claim it. The operator
calls just these parts for what changed; `demand` is their sum.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from application_manager.core import byhand
from application_manager.core.claims import (
    Claim,
    InvalidTemplate,
    Refusal,
    Refused,
    all_instances,
    claim,
    template_of_all,
)
from application_manager.core.lapses import live_claims
from application_manager.core.leases import LeaseView
from application_manager.core.operations import Standing, Verdict, gathered, settle, waiting_for_any
from application_manager.core.parameters import baseline
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate
from wayside.api.applicationtemplate import Lifecycle
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL, Duration
from wayside.times import parse_seconds

LINGER_ANNOTATION = "wayside.dev/linger"
"""On an instance: its template's linger, for when the template is gone."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What should become of one instance.

    Attributes:
        parameters: the merged values; None where they stay as they are.
        tasks: the tasks that contribute, in their order.
        verdicts: of all tasks that claim the instance, by task name.
        release_time: when it goes, in seconds since 1970; None: it stays.
        next_change: when this decision changes by itself, in seconds since 1970; None: not at all.
        paused: whether a person wants the instance and its objects left as they are.
        withheld: whether the pause keeps merged values from the instance.
        capped: a word about each merged sum that is held at its parameter's bound.
        baseline: whether the template demands it by itself.
        suspended: whether it is to be at zero; None where that stays as it is.
        suspender: the task that suspends it.
    """

    name: str
    template: str
    key: str | None
    parameters: dict[str, object] | None
    tasks: tuple[str, ...]
    verdicts: dict[str, Verdict]
    release_time: float | None
    next_change: float | None
    paused: bool = False
    withheld: bool = False
    capped: tuple[str, ...] = ()
    baseline: bool = False
    suspended: bool | None = None
    suspender: str | None = None

    @property
    def wanted(self) -> bool:
        """Whether any task demands it, or its template by itself."""
        return bool(self.tasks) or self.baseline


@dataclass(frozen=True, slots=True)
class Outcome:
    """What should become of a whole namespace, by name; only instances that exist or should."""

    instances: dict[str, Decision]
    verdicts: dict[str, Verdict]
    next_change: float | None


def demand(
    templates: Iterable[ApplicationTemplate | InvalidTemplate],
    tasks: Iterable[ApplicationTask],
    instances: Iterable[ApplicationInstance],
    leases: Mapping[str, LeaseView],
    now: float,
) -> Outcome:
    """What should run in one namespace.

    Args:
        templates: all of the namespace, as all else.
        tasks: those being deleted count no more.
        instances: with their status, which holds the deadline of a linger.
        leases: by holder; a holder that is missing is not lost.
        now: seconds since 1970.
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
    decisions: dict[str, Decision] = {}
    for name in sorted(claimed.keys() | existing.keys() | always):
        instance, claims = existing.get(name), claimed.get(name, [])
        template = instance.spec.template if instance else claims[0].task.spec.template if claims else name
        claims = [*claims, *to_all.get(all_instances(template), [])]
        decision = decide(
            name,
            template,
            template=by_name.get(template),
            claims=claims,
            instance=instance,
            deadline=written_deadline(instance) if instance else None,
            leases=leases,
            now=now,
        )
        verdicts |= decision.verdicts
        if decision.wanted or instance:
            decisions[name] = decision
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
    return Outcome(decisions, verdicts, min(changes, default=None))


def has_baseline(template: ApplicationTemplate | InvalidTemplate | None) -> bool:
    """Whether the template demands its instance, which has its name, by itself."""
    return isinstance(template, ApplicationTemplate) and baseline(template) is not None


def claim_or_verdict(template: ApplicationTemplate | InvalidTemplate | None, task: ApplicationTask) -> Claim | Verdict:
    """What the task claims, or its verdict where it claims nothing, because it has ended or is refused."""
    if task.spec.end_time is not None:
        return Verdict(Standing.FINISHED, "Ended", f"the demand ended at {task.spec.end_time}")
    if task.metadata.deletion_timestamp is not None:
        return Verdict(Standing.FINISHED, "Deleted", "the task is being deleted")
    claimed = claim(template, task)
    if isinstance(claimed, Refusal):
        return Verdict(Standing.REFUSED, claimed.reason, claimed.message)
    return claimed


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
) -> Decision:
    """What should become of the instance, given the tasks that claim it.

    `deadline` is the release time of the decision before this one, None where that said to keep the instance: the
    linger goes on while no demand comes, and begins anew after one came.
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
        release_time = now + linger if deadline is None else deadline
        changes.append(release_time)
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
        parameters=None if paused else settled.parameters,
        tasks=settled.tasks,
        verdicts=verdicts | settled.verdicts,
        release_time=release_time,
        next_change=min((change for change in changes if change > now), default=None),
        paused=paused,
        withheld=withheld,
        capped=settled.capped,
        baseline=settled.baseline,
        suspended=suspended,
        suspender=settled.suspender,
    )


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


def is_managed(instance: ApplicationInstance) -> bool:
    """Whether the manager made the instance; a person's is never changed or released."""
    return instance.metadata.labels.get(MANAGED_BY_LABEL) == MANAGED_BY


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


def written_deadline(instance: ApplicationInstance) -> float | None:
    """The release time that the status holds, in seconds since 1970: what survives our own restart."""
    written = instance.status.release_time if instance.status else None
    return None if written is None else parse_seconds(written)


def linger_of(instance: ApplicationInstance, template: ApplicationTemplate | None) -> Duration:
    """How long the instance lingers: as its template says, or said while there was one."""
    if template is not None:
        return template.spec.lifecycle.linger
    noted = instance.metadata.annotations.get(LINGER_ANNOTATION)
    try:
        return Duration.parse(noted) if noted else Lifecycle().linger
    except ValueError:
        return Lifecycle().linger  # somebody wrote something else into the annotation
