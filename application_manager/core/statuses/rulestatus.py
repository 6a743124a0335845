"""Statuses of EventRules and Detectors: whether a detector can evaluate them, and the errors if not. Pure.

The compiler of the detector checks them here too. It does not know the ROS message types, so only the detector itself
reports a wrong type or field of a message: the message of the condition states this limit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from application_manager.core.conditions import ConditionState, concluded, find
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.rulefindings import RuleContext, detector_findings, selecting, selects
from application_manager.core.health.pods import Trouble, summary, trouble
from application_manager.core.health.readiness import not_ready
from application_manager.core.objects.sidecars import sidecar_pods
from wayside.api import Detector, EventRule
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus

Status = EventRuleStatus | DetectorStatus

RULE_INVALID = "RuleInvalid"
DETECTOR_INVALID = "DetectorInvalid"
"""Reasons of the condition Accepted of rules and detectors that cannot be evaluated."""

RUNNING = "Running"
"""The condition's type."""

NOT_RUN = ConditionState(
    RUNNING,
    False,
    "NotRun",
    "the manager runs no detectors: start it with --detector-image, and apply the roles that `application-manager "
    "rbac --detectors` prints; or remove spec.mode and run the detector yourself",
)
"""The condition if the manager has no image of detectors."""

NOT_ACCEPTED = ConditionState(
    RUNNING, False, "NotAccepted", "no objects are created for a Detector that is not accepted"
)
"""The condition of a Detector that cannot run and has no objects."""

_NOT_PROCESSED = ConditionState(
    RUNNING, False, "Pending", "the manager has not processed this generation yet", unknown=True
)
"""The condition of a Detector whose objects were not checked since it changed."""

_NAMES_LISTED = 5  # names to list in a column of a table

_AS_FAR_AS = "message types are checked only by the detector, which logs errors in them"


def rule_status(rule: EventRule, context: RuleContext, now: float) -> EventRuleStatus:
    """The rule's status as of `now`, in seconds since 1970."""
    names = [each.name for each in selecting(rule, context.detectors)]
    findings = context.findings(rule)
    old = rule.status or EventRuleStatus()
    generation = rule.metadata.generation
    return EventRuleStatus(
        observed_generation=generation,
        detectors=names,
        selected_by=_listed(names),
        conditions=concluded(
            old.conditions, [_rule_condition(findings, bool(names))], generation, now, stalled=(RULE_INVALID,)
        ),
    )


def _listed(names: Sequence[str]) -> str:
    """The names as one text, shortened if there are many."""
    more = f", and {len(names) - _NAMES_LISTED} more" if len(names) > _NAMES_LISTED else ""
    return ", ".join(names[:_NAMES_LISTED]) + more


def detector_status(
    detector: Detector, rules: Sequence[EventRule], now: float, running: ConditionState | None = None
) -> DetectorStatus:
    """The detector's status, given the rules of its namespace; `now` is in seconds since 1970.

    `running`: whether this generation of it runs, if it has a mode; None if the manager has not checked since its
    start.
    """
    old = detector.status or DetectorStatus()
    generation = detector.metadata.generation
    states = [_accepted(detector_findings(detector), DETECTOR_INVALID)]
    if detector.spec.mode is not None:
        states.append(running or _known_running(old, generation))
    kept = [each for each in old.conditions if detector.spec.mode is not None or each.type != RUNNING]
    return DetectorStatus(
        observed_generation=generation,
        rules=sum(1 for each in rules if selects(detector, each)),
        conditions=concluded(kept, states, generation, now, stalled=(DETECTOR_INVALID,)),
    )


def _known_running(status: DetectorStatus, generation: int) -> ConditionState:
    """Whether this generation of the detector runs, by its status."""
    known = find(status.conditions, RUNNING)
    if known is None or known.observed_generation != generation or known.status == "Unknown":
        return _NOT_PROCESSED
    return ConditionState(RUNNING, known.status == "True", known.reason, known.message)


def unreadable_status(status: Status, reason: str, problem: str, generation: int, now: float) -> Status:
    """The status of an invalid rule or detector that the API server accepted; `now` is in seconds since 1970."""
    state = ConditionState("Accepted", False, reason, problem)
    conditions = concluded(status.conditions, [state], generation, now, stalled=(reason,))
    return status.model_copy(update={"observed_generation": generation, "conditions": conditions})


def _rule_condition(findings: Findings, selected: bool) -> ConditionState:
    if selected or findings.problems:
        return _accepted(findings, RULE_INVALID)
    return ConditionState("Accepted", False, "NotSelected", "; ".join(map(str, findings.doubts)))


def _accepted(findings: Findings, reason: str) -> ConditionState:
    if findings.faults:
        return ConditionState("Accepted", False, reason, "; ".join(findings.faults))
    but = f"; but {'; '.join(map(str, findings.remarks))}" if findings.remarks else ""
    return ConditionState("Accepted", True, "Accepted", f"no errors found; {_AS_FAR_AS}{but}")


def running_in_pods(detector: Detector, pods: Sequence[Mapping[str, Any]]) -> ConditionState:
    """The condition Running of a Sidecar detector, by the pods that request it; finished pods do not count."""
    if not detector.spec.service_account_names:
        return ConditionState(
            RUNNING, False, "NoAccounts", "spec.serviceAccountNames: is empty: list the service accounts of its pods"
        )
    pods = [each for each in pods if not _is_over(each)]
    sidecars = list(sidecar_pods(pods))
    troubles = summary(found for each in sidecars if (found := trouble(each)) is not None)
    of = f"of {len(pods)} pods with its label"
    running = sum(1 for each in sidecars if _runs(each))
    if troubles:
        return ConditionState(
            RUNNING, False, troubles[0].reason.value, f"it runs in {running} {of}: {troubles[0].text}"
        )
    missing = len(pods) - len(sidecars)
    but = f"; {missing} without a detector: their Events report why" if missing else ""
    if pods and not running:
        return ConditionState(RUNNING, False, "NotReady", f"it runs in 0 {of}{but}")
    return ConditionState(RUNNING, True, "InPods", f"it runs in {running} {of}{but}")


def _is_over(pod: Mapping[str, Any]) -> bool:
    """Whether the pod has finished or is about to, like a Job's pod whose own containers have finished."""
    status, spec = pod.get("status") or {}, pod.get("spec") or {}
    if pod["metadata"].get("deletionTimestamp") or status.get("phase") in ("Succeeded", "Failed"):
        return True
    own = [each.get("state") or {} for each in status.get("containerStatuses") or ()]
    return bool(own) and spec.get("restartPolicy") != "Always" and all("terminated" in each for each in own)


def _runs(pod: Mapping[str, Any]) -> bool:
    return any("running" in (each.get("state") or {}) for each in pod["status"]["initContainerStatuses"])


def running(deployment: Mapping[str, Any] | None, troubles: Sequence[Trouble]) -> ConditionState:
    """The condition Running, by the Deployment and the problems of its pods."""
    if deployment is None:
        return ConditionState(RUNNING, False, "NotReady", "its Deployment does not exist yet")
    what = f"Deployment {deployment['metadata']['name']}"
    problem = not_ready(deployment)
    if problem is None:
        return ConditionState(RUNNING, True, "Running", f"{what} runs it")
    if troubles:
        return ConditionState(RUNNING, False, troubles[0].reason.value, f"{what} {problem}: {troubles[0].text}")
    return ConditionState(RUNNING, False, "NotReady", f"{what} {problem}")
