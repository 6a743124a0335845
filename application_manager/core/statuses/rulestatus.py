"""Statuses of EventRules and Detectors: whether a detector can evaluate them, and if not, what is wrong where. Pure.

The same compiler that the detector runs judges here. It does not know the message types of ROS, which are the
detector's to know, so a misspelt type, or field of a message, is reported by the detector alone: what is accepted here
is accepted as far as can be known, which the message adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from application_manager.core.conditions import Aspect, concluded
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.rulefindings import detector_findings, rule_findings, selecting, selects
from application_manager.core.statuses.running import RUNNING
from wayside.api import Detector, EventRule
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus
from wayside.findings import Finding

Status = TypeVar("Status", EventRuleStatus, DetectorStatus)

RULE_INVALID = "RuleInvalid"
DETECTOR_INVALID = "DetectorInvalid"
"""Reasons of the condition Accepted of what cannot be evaluated."""

_NAMES_LISTED = 5  # in a column of a table

_AS_FAR_AS = "message types are checked only by the detector, which logs errors in them"


def rule_status(
    rule: EventRule,
    detectors: Sequence[Detector],
    now: float,
    invalid: Sequence[str] = (),
    others: Sequence[EventRule] = (),
    remarks: Sequence[Finding] = (),
) -> EventRuleStatus:
    """The rule's status.

    Args:
        rule: the rule.
        detectors: those of its namespace that are valid.
        now: seconds since 1970.
        invalid: the names of its namespace's other detectors.
        others: the rules of its namespace, which its signals may name.
        remarks: what else is worth knowing of it.
    """
    selected = selecting(rule, detectors)
    findings = replace(rule_findings(rule, detectors, invalid, others), remarks=tuple(remarks))
    old = rule.status or EventRuleStatus()
    generation = rule.metadata.generation
    return EventRuleStatus(
        observed_generation=generation,
        detectors=[each.name for each in selected],
        selected_by=_listed([each.name for each in selected]),
        conditions=list(
            concluded(
                old.conditions, [_rule_aspect(findings, bool(selected))], generation, now, stalled=(RULE_INVALID,)
            )
        ),
    )


def _listed(names: Sequence[str]) -> str:
    """The names as one text; of many, the first ones."""
    more = f", and {len(names) - _NAMES_LISTED} more" if len(names) > _NAMES_LISTED else ""
    return ", ".join(names[:_NAMES_LISTED]) + more


def detector_status(
    detector: Detector, rules: Sequence[EventRule], now: float, running: Aspect | None = None
) -> DetectorStatus:
    """The detector's status.

    Args:
        detector: the Detector.
        rules: those of its namespace.
        now: seconds since 1970.
        running: whether it runs, where the manager runs it and knows.
    """
    old = detector.status or DetectorStatus()
    aspects = [_aspect(detector_findings(detector), DETECTOR_INVALID), *([] if running is None else [running])]
    kept = [each for each in old.conditions if detector.spec.mode is not None or each.type != RUNNING]
    generation = detector.metadata.generation
    return DetectorStatus(
        observed_generation=generation,
        rules=sum(1 for each in rules if selects(detector, each)),
        conditions=list(concluded(kept, aspects, generation, now, stalled=(DETECTOR_INVALID,))),
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
    conditions = list(concluded(status.conditions, [aspect], generation, now, stalled=(reason,)))
    return status.model_copy(update={"observed_generation": generation, "conditions": conditions})


def _rule_aspect(findings: Findings, selected: bool) -> Aspect:
    if selected or findings.problems:
        return _aspect(findings, RULE_INVALID)
    return Aspect("Accepted", False, "NotSelected", "; ".join(map(str, findings.doubts)))


def _aspect(findings: Findings, reason: str) -> Aspect:
    if findings.faults:
        return Aspect("Accepted", False, reason, "; ".join(findings.faults))
    but = f"; but {'; '.join(map(str, findings.remarks))}" if findings.remarks else ""
    return Aspect("Accepted", True, "Accepted", f"no errors found; {_AS_FAR_AS}{but}")
