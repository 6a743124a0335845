"""The findings of `application-manager check`, of the webhook and of the condition Accepted, by name."""

from __future__ import annotations

from wayside.findings import INVALID_DETECTOR, UNREADABLE_FILE, Check, Severity

INVALID_TEMPLATE = Check("invalid-template", Severity.ERROR, "an ApplicationTemplate cannot be rendered")
INVALID_RULE = Check("invalid-rule", Severity.ERROR, "an EventRule does not compile with any Detector that selects it")
RULE_NOT_SELECTED = Check("rule-not-selected", Severity.WARNING, "no valid Detector selects the EventRule")
RULE_NOT_READY = Check(
    "rule-not-ready",
    Severity.WARNING,
    "an EventRule does not compile with some of the Detectors that select it, or reads a rule that does not exist yet",
)
UNKNOWN_TEMPLATE = Check(
    "unknown-template", Severity.WARNING, "a deploy action names an ApplicationTemplate that does not exist"
)
DEPLOY_PARAMETERS = Check(
    "deploy-parameters", Severity.WARNING, "the template would refuse the parameters of a deploy action"
)
FAILING_EXAMPLE = Check(
    "failing-example", Severity.WARNING, "an ApplicationTemplate cannot be rendered with example values"
)
BROKEN_RULE = Check(
    "broken-rule", Severity.WARNING, "in the webhook: an EventRule no longer compiles with a changed Detector"
)

CHECKS = (
    UNREADABLE_FILE,
    INVALID_TEMPLATE,
    INVALID_DETECTOR,
    INVALID_RULE,
    RULE_NOT_SELECTED,
    RULE_NOT_READY,
    UNKNOWN_TEMPLATE,
    DEPLOY_PARAMETERS,
    FAILING_EXAMPLE,
    BROKEN_RULE,
)
"""All findings."""
