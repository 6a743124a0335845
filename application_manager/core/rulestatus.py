"""Statuses of EventRules and Detectors: whether a detector can evaluate them, and if not, what is wrong where. Pure.

The same compiler that the detector runs judges here. It does not know the message types of ROS, which are the
detector's to know, so a misspelt type, or field of a message, is told by the detector alone: what is accepted here is
accepted as far as can be told, and says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from application_manager.core.conditions import Aspect, updated
from wayside.api import Detector, EventRule
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus
from wayside.rules import RuleError, compile_rule, dependency_problems, source_problems, stream_problems

Status = TypeVar("Status", EventRuleStatus, DetectorStatus)

_AS_FAR_AS = "as far as can be told without the message types; what they show to be wrong, the detector's log says"


def rule_status(
    rule: EventRule,
    detectors: Sequence[Detector],
    now: float,
    invalid: Sequence[str] = (),
    others: Sequence[EventRule] = (),
) -> EventRuleStatus:
    """The rule's status.

    Args:
        rule: the rule.
        detectors: those of its namespace that are valid.
        now: seconds since 1970.
        invalid: the names of its namespace's other detectors.
        others: the rules of its namespace, which its signals may name.
    """
    selecting = sorted((each for each in detectors if selects(each, rule)), key=lambda each: each.name)
    old = rule.status or EventRuleStatus()
    generation = rule.metadata.generation
    return EventRuleStatus(
        observed_generation=generation,
        detectors=[each.name for each in selecting],
        conditions=list(
            updated(old.conditions, (_rule_aspect(rule, selecting, detectors, invalid, others),), generation, now)
        ),
    )


def detector_status(detector: Detector, rules: Sequence[EventRule], now: float) -> DetectorStatus:
    """The detector's status; `rules` are those of its namespace, `now` is in seconds since 1970."""
    old = detector.status or DetectorStatus()
    problems = [
        str(problem) for index, stream in enumerate(detector.spec.streams) for problem in stream_problems(stream, index)
    ]
    problems += map(str, source_problems(detector))
    if problems:
        aspect = Aspect("Accepted", False, "DetectorInvalid", "; ".join(problems))
    else:
        aspect = Aspect("Accepted", True, "Accepted", f"nothing is wrong, {_AS_FAR_AS}")
    generation = detector.metadata.generation
    return DetectorStatus(
        observed_generation=generation,
        rules=sum(1 for each in rules if selects(detector, each)),
        conditions=list(updated(old.conditions, (aspect,), generation, now)),
    )


def unreadable_status(status: Status, reason: str, problem: str, generation: int, now: float) -> Status:
    """The status of a rule or detector that the API server took and that is none.

    Args:
        status: as it is.
        reason: for programs.
        problem: what is wrong, with its field and the remedy.
        generation: the object's.
        now: seconds since 1970.
    """
    aspect = Aspect("Accepted", False, reason, problem)
    conditions = list(updated(status.conditions, (aspect,), generation, now))
    return status.model_copy(update={"observed_generation": generation, "conditions": conditions})


def selects(detector: Detector, rule: EventRule) -> bool:
    """Whether the detector evaluates the rule, which is in its namespace."""
    return detector.spec.rules.matches(rule.metadata.labels)


def _rule_aspect(
    rule: EventRule,
    selecting: Sequence[Detector],
    detectors: Sequence[Detector],
    invalid: Sequence[str],
    others: Sequence[EventRule],
) -> Aspect:
    if not selecting:
        wanted = [f"{each.name} selects {_labels(each)}" for each in sorted(detectors, key=lambda each: each.name)]
        remedies = [f"add labels to metadata.labels: {'; '.join(wanted)}"] if wanted else []
        remedies += [f"correct Detector {name}, whose status says what is wrong with it" for name in sorted(invalid)]
        remedy = "; or ".join(remedies) or "create a Detector"
        message = f"no valid Detector in namespace {rule.namespace} selects the rule: {remedy}"
        return Aspect("Accepted", False, "NotSelected", message)
    problems: dict[str, list[str]] = {}  # problem → detectors that have it
    for detector in selecting:
        try:
            beside = [each for each in others if each.name != rule.name and selects(detector, each)]
            compile_rule(rule, detector, None, dependency_problems([rule, *beside]).get(rule.name, ()))
        except RuleError as error:
            for problem in error.problems:
                problems.setdefault(str(problem), []).append(detector.name)
    if not problems:
        return Aspect("Accepted", True, "Accepted", f"nothing is wrong, {_AS_FAR_AS}")
    told = [
        problem if len(names) == len(selecting) else f"with Detector {', '.join(names)}: {problem}"
        for problem, names in problems.items()
    ]
    return Aspect("Accepted", False, "RuleInvalid", "; ".join(told))


def _labels(detector: Detector) -> str:
    return ", ".join(f"{key}={value}" for key, value in sorted(detector.spec.rules.match_labels.items())) or "all"
