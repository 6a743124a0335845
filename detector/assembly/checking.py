"""The findings of `detector check`: every problem of Detectors and rules, with file, line and column."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from detector.assembly import DetectorError, StreamReaders, offer_problems, stream_readers
from detector.findings.checks import (
    INVALID_RULE,
    MISSING_DETECTOR,
    RULE_NOT_SELECTED,
    STREAM_WITHOUT_STAMPS,
    UNKNOWN_RULE,
)
from detector.onnx.binding import bind_models
from detector.sources.registry import source_plugin_problems
from wayside.api import Detector, EventRule
from wayside.api.detector import Clock
from wayside.api.documents import Document, Problem
from wayside.api.stream import Encoding, Stream
from wayside.findings import INVALID_DETECTOR
from wayside.rules import Fields, RuleError, RuleProblem, compile_rule, dependency_problems, unknown_rules
from wayside.rules.contradictions import contradictions

_CHECKED = (Detector, EventRule)


class CheckResult(NamedTuple):
    """Errors, and the warnings that their object's annotation does not ignore."""

    problems: list[Problem]
    warnings: list[Problem]


def findings(documents: Sequence[Document]) -> CheckResult:
    """The findings about the Detectors, and about the rules with each Detector that selects them."""
    problems: list[Problem] = []
    warnings: list[Problem] = []
    detectors: list[tuple[Document, Detector, StreamReaders]] = []
    for document in documents:
        if isinstance(document.object, Detector):
            try:
                problems += [
                    document.problem(each.path, each.message, INVALID_DETECTOR.name)
                    for each in source_plugin_problems(document.object)
                ]
                readers = stream_readers(document.object)
                detectors.append((document, document.object, readers))
                warnings += _unignored(document, _without_stamps(document, document.object, readers))
            except DetectorError as error:
                problems += [
                    document.problem(each.path, each.message, INVALID_DETECTOR.name) for each in error.problems
                ]
    any_detector = any(isinstance(document.object, Detector) for document in documents)
    rules = [document for document in documents if isinstance(document.object, EventRule)]
    if rules and not any_detector:
        missing = "a rule is checked against its Detector: give the file of the Detector as well"
        problems.append(rules[0].problem((), missing, MISSING_DETECTOR.name))
    wrong = {
        detector.name: dependency_problems(
            [rule for rule in _objects(rules) if detector.spec.rule_selector.matches(rule.metadata.labels)]
        )
        for _, detector, _ in detectors
    }
    for document in rules:
        problems += _rule_problems(document, detectors, wrong, _by_name(rules), warnings)
    names = [document.object.name for document in rules]
    for of_detector, detector, _ in detectors if rules else ():
        problems += [
            of_detector.problem(path, text, UNKNOWN_RULE.name) for path, text in unknown_rules(detector, names)
        ]
    return CheckResult(list(dict.fromkeys(problems)), list(dict.fromkeys(warnings)))


def _without_stamps(document: Document, detector: Detector, readers: StreamReaders) -> Iterator[Problem]:
    """With clock Data, the streams without stamps beside others that have them."""
    streams = [] if detector.spec.clock is Clock.WALL else list(enumerate(detector.spec.streams))
    without = [
        (index, stream)
        for index, stream in streams
        if not stream.latched and not _has_stamp(stream, readers.fields.get(stream.name))
    ]
    if len(without) < sum(not stream.latched for _, stream in streams):
        for index, stream in without:
            yield document.problem(
                ("spec", "streams", index),
                f"stream {stream.name} has no stamp, unlike others: with clock Data its receive time is used; "
                "give its stamp, e.g. msg.time or sample.received, or write clock: Wall",
                STREAM_WITHOUT_STAMPS.name,
            )


def _unignored(document: Document, warnings: Iterable[Problem]) -> Iterator[Problem]:
    """The warnings of an object that its annotation does not ignore."""
    return (each for each in warnings if not document.ignores(each.check))


def _has_stamp(stream: Stream, fields: Fields | None) -> bool:
    """Whether its messages can contain the time of the sender."""
    if stream.stamp is not None or stream.encoding is Encoding.UPER:
        return True
    if stream.encoding is not Encoding.CDR:
        return False
    header = None if fields is None else fields.get("header")
    return fields is None or (header is not None and "stamp" in header)


def _objects(documents: Iterable[Document]) -> Iterator[EventRule]:
    return (document.object for document in documents if isinstance(document.object, EventRule))


def _by_name(documents: Iterable[Document]) -> dict[str, EventRule]:
    return {rule.name: rule for rule in _objects(documents)}


def _rule_problems(
    document: Document,
    detectors: Sequence[tuple[Document, Detector, StreamReaders]],
    wrong: Mapping[str, Mapping[str, Sequence[RuleProblem]]],
    others: Mapping[str, EventRule],
    warnings: list[Problem],
) -> Iterator[Problem]:
    rule = document.object
    assert isinstance(rule, EventRule)  # noqa: S101  the caller picked it
    selecting = [each for each in detectors if each[1].spec.rule_selector.matches(rule.metadata.labels)]
    if detectors and not selecting:
        names = ", ".join(detector.name for _, detector, _ in detectors)
        unselected = f"no Detector selects the rule: compare spec.ruleSelector of {names}"
        yield document.problem(("metadata", "labels"), unselected, RULE_NOT_SELECTED.name)
    for of_detector, detector, readers in selecting:
        try:
            known = (*wrong[detector.name].get(rule.name, ()), *offer_problems(rule, detector))
            compiled = compile_rule(rule, detector, readers.fields, known, readers.places)
            bind_models(compiled)
        except RuleError as error:
            for each in error.problems:
                place = document if each.detector is None else of_detector
                yield place.problem(each.path, each.message, INVALID_RULE.name)
        else:
            found = contradictions(rule, compiled, detector, others)
            warnings += _unignored(document, (document.problem(each.path, each.message, each.check) for each in found))


def checked_summary(documents: Sequence[Document]) -> str:
    """A summary of the checked and the skipped objects."""
    counts = Counter(type(document.object).__name__ for document in documents)
    looked = ", ".join(_counted(counts.pop(kind.__name__, 0), kind.__name__) for kind in _CHECKED)
    if not counts:
        return looked
    others = ", ".join(_counted(count, kind) for kind, count in sorted(counts.items()))
    return f"{looked} (not checked: {others}; see `application-manager render`)"


def _counted(count: int, kind: str) -> str:
    return f"{count} {kind}{'' if count == 1 else 's'}"
