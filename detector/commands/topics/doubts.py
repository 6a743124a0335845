"""Findings from a recording about Detectors and rules before the replay: misspelt fields, unmatched streams."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from detector.assembly import DetectorError, stream_readers
from detector.commands.topics.proposal import Proposal
from detector.commands.topics.survey import MessageShape, Topic, topic_shape
from detector.findings.checks import FIELD_NOT_RECORDED, UNMATCHED_STREAM
from detector.resources.selection import select
from wayside.api import Detector, EventRule
from wayside.api.documents import Document, Problem
from wayside.api.stream import Encoding, Stream
from wayside.keys import KeyPattern
from wayside.rules import Fields, RuleError, compile_rule

_SHOWN = 10


def topic_doubts(documents: Sequence[Document], topics: Sequence[Topic]) -> Iterator[Problem]:
    """Warnings, at their places in the files, which are free of errors otherwise."""
    rules = [document for document in documents if isinstance(document.object, EventRule)]
    for document in documents:
        detector = document.object
        if not isinstance(detector, Detector):
            continue
        try:
            known = stream_readers(detector).fields
        except DetectorError:
            continue  # a type that the recording defines
        seen: dict[str, Fields] = {}
        for index, stream in enumerate(detector.spec.streams):
            own = _topics_of(stream, topics)
            if not own and not document.ignores(UNMATCHED_STREAM.name):
                keys = ", ".join(sorted(topic.key for topic in topics)[:_SHOWN])
                yield document.problem(
                    ("spec", "streams", index, "key"),
                    f"no message of the recording belongs to stream {stream.name}; its keys are {keys}",
                    UNMATCHED_STREAM.name,
                )
            fields = _seen(stream.encoding, own)
            if fields is not None:
                seen[stream.name] = fields
        yield from _fields_missing(detector, rules, {**known, **seen})


def _fields_missing(detector: Detector, rules: Sequence[Document], fields: dict[str, Fields]) -> Iterator[Problem]:
    """Fields that rules name, but no inspected message has."""
    selected = {rule.name for rule in select(detector, [_rule(document) for document in rules]).rules}
    for document in rules:
        if document.object.name not in selected or document.ignores(FIELD_NOT_RECORDED.name):
            continue
        try:
            compile_rule(_rule(document), detector, fields)
        except RuleError as error:
            for each in error.problems:
                if " has no field " in each.message:
                    yield document.problem(each.path, f"in the recording, {each.message}", FIELD_NOT_RECORDED.name)


def _rule(document: Document) -> EventRule:
    assert isinstance(document.object, EventRule)  # noqa: S101  the caller picked it
    return document.object


def _topics_of(stream: Stream, topics: Sequence[Topic]) -> list[Topic]:
    pattern = KeyPattern.parse(stream.key)
    return [topic for topic in topics if pattern.match(topic.key) is not None]


def fields_of(found: Sequence[Proposal]) -> dict[str, Fields]:
    """By stream, the fields of JSON and CBOR messages found in the samples, as far as the messages are maps."""
    named = {each.name: _seen(each.encoding, each.topics) for each in found}
    return {name: fields for name, fields in named.items() if fields is not None}


def _seen(encoding: Encoding, topics: Sequence[Topic]) -> Fields | None:
    """The fields of JSON and CBOR messages found in the samples of all topics; None if they are not maps."""
    if encoding not in (Encoding.JSON, Encoding.CBOR) or not topics:
        return None
    whole = MessageShape()
    for topic in topics:
        shape = topic_shape(topic, encoding)
        if shape is None:
            return None
        whole.join(shape)
    return whole.known_fields
