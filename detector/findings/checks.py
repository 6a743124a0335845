"""The findings of `detector check`, by name."""

from __future__ import annotations

from wayside.findings import INVALID_DETECTOR, UNREADABLE_FILE, Check, Severity
from wayside.rules.contradictions import CONTRADICTIONS

INVALID_RULE = Check("invalid-rule", Severity.ERROR, "an EventRule does not compile with a Detector that selects it")
MISSING_DETECTOR = Check("missing-detector", Severity.ERROR, "the files have EventRules, but no Detector")
RULE_NOT_SELECTED = Check("rule-not-selected", Severity.ERROR, "no Detector selects the EventRule")
UNKNOWN_RULE = Check("unknown-rule", Severity.ERROR, "a Detector has parameters for an EventRule that does not exist")
UNREADABLE_RECORDING = Check(
    "unreadable-recording", Severity.ERROR, "with --recording: a recording cannot be read, or is damaged"
)
STREAM_WITHOUT_STAMPS = Check(
    "stream-without-stamps",
    Severity.WARNING,
    "with clock Data: a stream has no stamps, but others do (by definition, or in a recording)",
)
UNMATCHED_STREAM = Check(
    "unmatched-stream", Severity.WARNING, "with --recording: no message belongs to a stream of the Detector"
)
FIELD_NOT_RECORDED = Check(
    "field-not-recorded", Severity.WARNING, "with --recording: an EventRule reads a field that no message has"
)
CUT_RECORDING = Check("cut-recording", Severity.WARNING, "with --recording: the end of a recording is missing")
ZERO_STAMPS = Check("zero-stamps", Severity.WARNING, "with --recording and clock Data: stamps of a stream are 0")
DIVERGING_STAMPS = Check(
    "diverging-stamps",
    Severity.WARNING,
    "with --recording and clock Data: stamps of a stream are over 1 s ahead of, or behind, those of the others",
)
STALE_BETWEEN_SAMPLES = Check(
    "stale-between-samples",
    Severity.WARNING,
    "with --recording: samples of a stream come less often than staleAfter allows",
)
OLD_SAMPLES = Check(
    "old-samples", Severity.WARNING, "with --recording: an EventRule used samples much older than the stream's period"
)

CHECKS = (
    UNREADABLE_FILE,
    INVALID_DETECTOR,
    INVALID_RULE,
    MISSING_DETECTOR,
    RULE_NOT_SELECTED,
    UNKNOWN_RULE,
    UNREADABLE_RECORDING,
    STREAM_WITHOUT_STAMPS,
    UNMATCHED_STREAM,
    FIELD_NOT_RECORDED,
    CUT_RECORDING,
    ZERO_STAMPS,
    DIVERGING_STAMPS,
    STALE_BETWEEN_SAMPLES,
    OLD_SAMPLES,
    *(Check(each.check, Severity.WARNING, each.description) for each in CONTRADICTIONS),
)
"""All of them."""
