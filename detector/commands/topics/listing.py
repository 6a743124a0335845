"""The topics of recordings as text: a block for each stream, with fields ready to paste."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from detector.assembly import DetectorError, inlets
from detector.commands.topics.proposal import Proposal, detector_document
from detector.commands.topics.shape import message_paths
from detector.commands.topics.survey import topic_shape
from detector.replay.gathering import Recording
from detector.replay.recorded_types import with_recorded_types
from wayside.api import Detector
from wayside.api.stream import Encoding
from wayside.manifests import to_yaml
from wayside.rules import Fields
from wayside.times import format_time


def lines(found: Sequence[Proposal], recordings: Sequence[Recording]) -> Iterator[str]:
    """The text for users. Raises RecordingError if a recording's definitions cannot be read."""
    types = _types(found, recordings)
    for each in found:
        yield each.key
        kind = each.type or (each.topics[0].recorded_as if each.encoding is Encoding.RAW else "")
        rate = each.rate
        worst = each.worst
        facts = [
            each.encoding.value + (f" ({kind})" if kind and kind != each.encoding.value else ""),
            "" if each.client is not None else _counted(len(each.clients), "client") + f": {_some(each.clients)}",
            _counted(each.count, "message"),
            "" if rate is None else f"{rate:.3g} Hz",
            "" if not worst.gap else f"longest gap {worst.gap / 1e9:.3g} s of {worst.key} at {_clock(worst.gap_time)}",
        ]
        yield "  " + ", ".join(fact for fact in facts if fact)
        fields = [*_fields(each, types)]
        width = min(max((len(path) for path, _ in fields), default=0), 50)
        for path, what in fields:
            yield f"    {path:{width}}  {what}".rstrip()


def _fields(each: Proposal, types: dict[str, Fields]) -> Iterator[tuple[str, str]]:
    found: dict[str, str] = {}
    for topic in each.topics:
        shape = topic_shape(topic, each.encoding)
        found.update(shape.paths() if shape is not None else ())
    if found:
        yield from found.items()
    elif types.get(each.name):
        yield from message_paths(types[each.name])
    elif each.encoding is Encoding.RAW:
        yield "msg", "bytes, for numberAt, utf8 and checksum"


def yaml_of(found: Sequence[Proposal], recordings: Sequence[Recording], zenoh: Mapping[str, Any] | None = None) -> str:
    """A Detector with the streams, and the definitions of types that only the recordings have."""
    completed = _completed(found, recordings)
    messages = [message.model_dump(mode="json", by_alias=True) for message in completed.spec.messages]
    return to_yaml([detector_document(found, messages, zenoh)])


def _completed(found: Sequence[Proposal], recordings: Sequence[Recording]) -> Detector:
    detector = Detector.model_validate(detector_document(found))
    files: list[Path] = [path for recording in recordings for path in recording]
    return with_recorded_types(detector, files)


def _types(found: Sequence[Proposal], recordings: Sequence[Recording]) -> dict[str, Fields]:
    """The fields of streams whose messages have a known type."""
    try:
        return {**inlets(_completed(found, recordings)).fields}
    except DetectorError:
        return {}  # a type without any definition


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (" …" if len(names) > 5 else "")


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def _clock(time: int) -> str:
    return format_time(time)[11:23]
