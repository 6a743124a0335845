"""The result of the live tasks of one instance: Deploy tasks merge, Reconfigure overrides, Suspend stops. Pure.

`combine` computes the result for one instance. A task for all instances of a template has a verdict from each of them;
`combined_verdict` summarizes these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from application_manager.core.claims.claims import Claim, RefusalReason, template_of_all
from application_manager.core.claims.merging import Contribution, Merged, merge, too_large
from application_manager.core.claims.parameters import baseline, with_defaults
from wayside.api import ApplicationTemplate
from wayside.api.operation import Operation

ACCEPTED = "Accepted"
"""Reason of the condition Accepted of a task that counts, if there is nothing else to report."""

NOTHING_RUNS = "NothingRuns"
"""Reason of the condition Accepted of a Reconfigure or Suspend task that waits for a Deploy task."""

_SHOWN = 5  # names of instances in a message


class VerdictKind(StrEnum):
    """The state of a task in the demand."""

    COUNTS = "Counts"
    WAITING = "Waiting"
    REFUSED = "Refused"
    LAPSED = "Lapsed"
    FINISHED = "Finished"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result for one task; reason and message are those of its condition Accepted or Finished.

    `instance`: the one that serves it; `acts`: whether it reconfigures or suspends an instance, instead of deploying
    it.
    """

    kind: VerdictKind
    reason: str
    message: str
    instance: str | None = None
    acts: bool = False


@dataclass(frozen=True, slots=True)
class CombinedClaims:
    """The result of the tasks of one instance.

    Attributes:
        tasks: the names of those that deploy it and contribute, in their order.
        baseline: whether the template itself demands it.
        parameters: the merged values with the defaults; None if there is no demand for the instance.
        suspender: the first task that suspends it and is not outbid.
        verdicts: of all tasks, by name.
        capped: a message about each capped sum.
        too_large: why the parameters are too large; empty if they are not.
    """

    tasks: tuple[str, ...]
    baseline: bool
    parameters: dict[str, Any] | None
    suspender: str | None
    verdicts: dict[str, Verdict]
    capped: tuple[str, ...]
    too_large: str = ""


def combine(name: str, template: ApplicationTemplate | None, claims: Sequence[Claim], exists: bool) -> CombinedClaims:
    """The result of the live claims, in their order of precedence; `exists`: whether the instance exists already."""
    declared = template.spec.parameters if template else {}
    always = baseline(template) if template else None
    deploying, changing, stopping = (
        [each for each in claims if each.operation is operation]
        for operation in (Operation.DEPLOY, Operation.RECONFIGURE, Operation.SUSPEND)
    )
    base = merge(declared, _contributions(deploying), always)
    layer = merge(declared, _contributions(changing))
    served = [each for each in deploying if each.task.name not in base.conflicts]
    demanded = bool(served) or always is not None
    suspended = [each for each in stopping if not _outbids(served, each)] if demanded or exists else []
    suspender = suspended[0].task.name if suspended else None

    verdicts: dict[str, Verdict] = {}
    for each in claims:
        verdicts[each.task.name] = (
            _deploy_verdict(name, each, base, suspender)
            if each.operation is Operation.DEPLOY
            else _change_verdict(name, each, layer, demanded)
            if each.operation is Operation.RECONFIGURE
            else _stop_verdict(name, each, served, demanded or exists)
        )
    parameters = with_defaults(declared, base.parameters | layer.parameters) if demanded else None
    return CombinedClaims(
        tasks=tuple(each.task.name for each in served),
        baseline=always is not None,
        parameters=parameters,
        suspender=suspender,
        verdicts=verdicts,
        capped=_capped(base, layer) if demanded else (),
        too_large=too_large(parameters or {}, _contributions([*served, *changing])),
    )


def _contributions(claims: Sequence[Claim]) -> list[Contribution]:
    return [Contribution(each.task.name, each.parameters) for each in claims]


def _capped(base: Merged, layer: Merged) -> tuple[str, ...]:
    """All values of the layer, and of the lower one those that it does not override."""
    return layer.capped + tuple(each for each in base.capped if each.partition(":")[0] not in layer.parameters)


def _outbids(served: Sequence[Claim], suspend: Claim) -> Claim | None:
    """The task that deploys the instance with a higher priority; the baseline never outbids."""
    first = served[0] if served else None
    return first if first is not None and first.task.spec.priority > suspend.task.spec.priority else None


def _deploy_verdict(name: str, each: Claim, base: Merged, suspender: str | None) -> Verdict:
    conflict = base.conflicts.get(each.task.name)
    if conflict is not None:
        return Verdict(VerdictKind.REFUSED, RefusalReason.CONFLICT, conflict.message())
    stopped = f", which task {suspender} suspends" if suspender else ""
    return Verdict(VerdictKind.COUNTS, ACCEPTED, f"counts for instance {name}{stopped}", name)


def _change_verdict(name: str, each: Claim, layer: Merged, demanded: bool) -> Verdict:
    conflict = layer.conflicts.get(each.task.name)
    if conflict is not None:
        return Verdict(VerdictKind.REFUSED, RefusalReason.CONFLICT, conflict.message())
    if not demanded:
        return _waiting(name, each)
    return Verdict(VerdictKind.COUNTS, ACCEPTED, f"reconfigures instance {name}", name, acts=True)


def _stop_verdict(name: str, each: Claim, served: Sequence[Claim], runs: bool) -> Verdict:
    if not runs:
        return _waiting(name, each)
    higher = _outbids(served, each)
    if higher is not None:
        message = (
            f"spec.priority: {each.task.spec.priority} is below the priority {higher.task.spec.priority} of task "
            f"{higher.task.name}, which deploys instance {name}: set at least that priority, or wait until that "
            "task ends"
        )
        return Verdict(VerdictKind.REFUSED, RefusalReason.OUTBID, message)
    return Verdict(VerdictKind.COUNTS, ACCEPTED, f"suspends instance {name}", name, acts=True)


def _waiting(name: str, each: Claim) -> Verdict:
    message = f"no task deploys instance {name}: this {each.operation} task waits until a Deploy task does"
    return Verdict(VerdictKind.WAITING, NOTHING_RUNS, message)


def waiting_for_any(claim: Claim) -> Verdict:
    """The verdict of a task for all instances of a template that has none."""
    message = (
        f"no task deploys an instance of template {template_of_all(claim.instance)}: this {claim.operation} task "
        "waits until a Deploy task does"
    )
    return Verdict(VerdictKind.WAITING, NOTHING_RUNS, message)


def combined_verdict(claim: Claim, parts: Mapping[str, Verdict], otherwise: Verdict) -> Verdict:
    """The verdict of a task for all instances of a template, combined from its verdicts by instance.

    `otherwise`: the verdict if there is no instance for it.
    """
    if otherwise.kind is not VerdictKind.WAITING:  # its holder is lost, which applies to all of them
        return otherwise
    counting = sorted(name for name, each in parts.items() if each.kind is VerdictKind.COUNTS)
    others = [each for _, each in sorted(parts.items()) if each.kind not in (VerdictKind.COUNTS, VerdictKind.WAITING)]
    if not counting:
        return others[0] if others else otherwise
    verb = "reconfigures" if claim.operation is Operation.RECONFIGURE else "suspends"
    names = ", ".join(counting[:_SHOWN]) + (f" and {len(counting) - _SHOWN} more" if len(counting) > _SHOWN else "")
    message = f"{verb} instance{'s' if len(counting) > 1 else ''} {names}"
    if others:
        message += f"; refused for {len(others)} (the first: {others[0].message})"
    return Verdict(VerdictKind.COUNTS, ACCEPTED, message, counting[0] if len(counting) == 1 else None)
