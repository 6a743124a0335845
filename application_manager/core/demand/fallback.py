"""Fallbacks of instances that do not become ready: `lifecycle.readyTimeout` and `fallback`. Pure.

An instance is overdue once it has not been ready for `readyTimeout` without interruption, and until it has been ready
for as long without interruption. Conditions of its status record both with their transition times, so a restart of the
manager changes nothing, and an instance that is ready only intermittently causes no flapping.

While it is overdue, its tasks also claim an instance of the fallback template, with those of their parameters that it
declares. The overdue instance stays, and retries. A fallback instance has no further fallback for these tasks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from application_manager.core.claims.claims import Claim, InvalidTemplate, Refusal, TemplateState, claim
from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.conditions import ConditionState, find, from_first, holds
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.api.base import Condition
from wayside.api.operation import Operation
from wayside.times import parse_seconds

TIMED_OUT = "TimedOut"
"""The condition of an overdue instance."""

READY_TIMEOUT = "ReadyTimeout"
"""Reason of the conditions Ready and TimedOut of an overdue instance."""

FALLEN_BACK = "FallenBack"
"""Reason of the condition Accepted of a task that the fallback serves."""

FALLBACK_FAILED = "FallbackFailed"
"""Reason of the condition Accepted of a task that the fallback cannot serve; the message has the cause."""


@dataclass(frozen=True, slots=True)
class Fallback:
    """The additional claims of an overdue instance's tasks: one for each task that the fallback template can serve.

    `refused`: by task, why the template cannot serve it.
    """

    template: str
    claims: tuple[Claim, ...]
    refused: Mapping[str, str] = field(default_factory=dict)

    def instance_of(self, task: str) -> str | None:
        """The fallback instance for the task; None if there is none."""
        return next((each.instance for each in self.claims if each.task.name == task), None)

    @property
    def instances(self) -> set[str]:
        """The fallback instances."""
        return {each.instance for each in self.claims}


def fallback_of(template: TemplateState) -> str | None:
    """The fallback of this template, if it has one."""
    if not isinstance(template, ApplicationTemplate) or template.spec.lifecycle.fallback is None:
        return None
    return template.spec.lifecycle.fallback.template_name


def overdue(instance: ApplicationInstance, template: TemplateState, now: float) -> tuple[str, float | None]:
    """The readyTimeout that the instance exceeded, empty if it did not; and when that changes by itself."""
    if not isinstance(template, ApplicationTemplate) or template.spec.lifecycle.ready_timeout is None:
        return "", None
    timeout = template.spec.lifecycle.ready_timeout
    conditions = instance.status.conditions if instance.status else []
    was, ready = holds(conditions, TIMED_OUT), find(conditions, "Ready")
    is_ready = ready is not None and ready.status == "True"
    written = ready is not None and ready.status != "Unknown"  # Unknown is the default of a new object
    since = ready.last_transition_time if ready is not None and written else instance.metadata.creation_timestamp
    applied = find(conditions, "Applied")
    # The objects of the last successful apply stay when an update is refused: they may well be ready.
    refused = applied is not None and applied.status == "False" and bool(instance.status and instance.status.spec_hash)
    if instance.spec.suspended or is_ready != was or not since or refused:
        return str(timeout) if was else "", None
    start = parse_seconds(since)
    if not is_ready and (resumed := find(conditions, "Suspended")) is not None:
        start = max(start, parse_seconds(resumed.last_transition_time))
    ends = start + timeout.seconds
    if now < ends:
        return str(timeout) if was else "", ends
    return "" if was else str(timeout), None


def fallback(instance: str, template: TemplateState, other: TemplateState, claims: Iterable[Claim]) -> Fallback | None:
    """The fallback claims of an overdue instance; None if its template has no fallback.

    `other`: the fallback template, None if there is none of that name; `claims`: those that deploy the instance and
    count.
    """
    name = fallback_of(template)
    if name is None:
        return None
    claims_there: list[Claim] = []
    refused: dict[str, str] = {}
    for each in claims:
        if each.operation is not Operation.DEPLOY or each.instead_of:
            continue
        if other is None:
            refused[each.task.name] = f"there is no ApplicationTemplate {name!r}: create it, or correct the fallback"
            continue
        result = _claim(other, each)
        if isinstance(result, Refusal):
            refused[each.task.name] = result.message
        else:
            claims_there.append(replace(result, task=each.task, instead_of=instance, fallback=name))
    return Fallback(name, tuple(claims_there), refused)


def _claim(other: ApplicationTemplate | InvalidTemplate, each: Claim) -> Claim | Refusal:
    if isinstance(other, InvalidTemplate):
        return claim(other, each.task)
    known = {name: value for name, value in each.task.spec.parameters.items() if name in other.spec.parameters}
    spec = each.task.spec.model_copy(update={"parameters": known})
    return claim(other, each.task.model_copy(update={"spec": spec}))


def with_fallback(verdict: Verdict, task: str, to: Fallback | None, others: Mapping[str, Verdict]) -> Verdict:
    """The task's verdict, with the result at the fallback.

    `verdict`: that of its own instance; `others`: the verdicts of the fallback instance, empty if it was not decided
    yet.
    """
    if to is None or verdict.kind is not VerdictKind.COUNTS or verdict.acts:
        return verdict
    refusal = to.refused.get(task)
    found = others.get(task)
    if refusal is None and found is not None and found.kind is VerdictKind.COUNTS:
        message = (
            f"instance {verdict.instance} is not ready; until it is, instance {found.instance} of template "
            f"{to.template} serves the task"
        )
        return replace(found, reason=FALLEN_BACK, message=message)
    if refusal is None and found is None:
        return verdict
    why = refusal or (found.message if found else "")
    message = f"instance {verdict.instance} is not ready, and its fallback, template {to.template}, cannot serve: {why}"
    return replace(verdict, reason=FALLBACK_FAILED, message=message)


def fallback_conditions(
    known: Iterable[Condition], late: str, to: Fallback | None, stands_in_for: Iterable[str]
) -> Iterator[ConditionState]:
    """The conditions TimedOut and StandsIn of an instance; each is absent until it is True for the first time.

    `late`: the readyTimeout that it exceeded, empty if it did not; `to`: the fallback of its tasks; `stands_in_for`:
    the instances whose tasks it serves.
    """
    conditions, others, timed_out = list(known), ", ".join(stands_in_for), None
    if late:
        message = f"this instance was not ready for {late}"
        if to is not None and to.instances:
            names = ", ".join(sorted(to.instances))
            message += (
                f": template {to.template} ({names}) serves its tasks until this instance has been ready for {late}"
            )
        elif to is not None and to.refused:
            message += f", and its fallback, template {to.template}, cannot serve: {next(iter(to.refused.values()))}"
        timed_out = READY_TIMEOUT, message
    yield from from_first(
        conditions, TIMED_OUT, timed_out, ("InTime", "the instance is ready, or within its readyTimeout")
    )
    stands_in = (
        ("Fallback", f"this instance serves the tasks of instances that are not ready: {others}") if others else None
    )
    yield from from_first(conditions, "StandsIn", stands_in, ("NoFallback", "the instance serves only its own tasks"))
