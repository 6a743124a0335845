"""Reads recordings once, and reports for each key the number, the regularity and the shape of its messages.

The shape of plain values: the fields of maps, the items of lists, and the kinds of values in them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from detector.engine.samples.sample import DecodeError
from detector.replay.batches import Batch, Channel
from detector.replay.gathering import Recording
from detector.replay.message import Truncation
from detector.replay.recordings import open_recordings
from detector.streams.codecs.cbor import CborDecoder
from wayside.api.stream import Encoding, Layout
from wayside.rules import Fields, ItemFields

_FIELDS = 500
"""Maximum number of names in a map: one with more is a table, not a message."""
_DEPTH = 12


class MessageShape:
    """The values at one place in messages."""

    def __init__(self) -> None:
        self.kinds: set[str] = set()
        """`number`, `boolean`, `text`, `bytes`, `list`, `map`, `null`."""
        self.fields: dict[str, MessageShape] = {}
        self.items: MessageShape | None = None

    def add(self, value: Any, depth: int = 0) -> None:
        """Add one more value."""
        kind = _kind(value)
        self.kinds.add(kind)
        if depth >= _DEPTH:
            return
        if kind == "map":
            for name, child in value.items():
                known = self.fields.get(name)
                if known is None:
                    if len(self.fields) >= _FIELDS:
                        continue
                    known = self.fields[name] = MessageShape()
                known.add(child, depth + 1)
        elif kind == "list" and value:
            self.items = self.items or MessageShape()
            for child in (value[0], value[-1]):
                self.items.add(child, depth + 1)

    def join(self, other: MessageShape) -> None:
        """Merge another shape into this one."""
        self.kinds |= other.kinds
        for name, child in other.fields.items():
            self.fields.setdefault(name, MessageShape()).join(child)
        if other.items is not None:
            self.items = self.items or MessageShape()
            self.items.join(other.items)

    @property
    def known_fields(self) -> Fields | None:
        """The fields for checking paths; None if values are neither maps nor lists of maps, or have too many names."""
        if self.items is not None and self.kinds <= {"list", "null"}:
            known = self.items.known_fields
            return None if known is None or isinstance(known, ItemFields) else ItemFields(known)
        if "map" not in self.kinds or not self.kinds <= {"map", "null"} or len(self.fields) >= _FIELDS:
            return None
        return {name: child.known_fields for name, child in self.fields.items()}

    def paths(self, above: str = "msg") -> Iterator[tuple[str, str]]:
        """Each place with its kinds, in the notation of expressions."""
        for name, child in self.fields.items():
            yield from child.paths(f"{above}.{name}" if name.isidentifier() else f'{above}["{name}"]')
        if self.items is not None and self.items.fields:
            yield from self.items.paths(f"{above}[0]")
        elif not self.fields:
            of = f" of {' or '.join(sorted(self.items.kinds))}" if self.items is not None else ""
            yield above, " or ".join(sorted(self.kinds)) + of


def message_paths(fields: Fields | None, above: str = "msg", depth: int = 0) -> Iterator[tuple[str, str]]:
    """The places of a message of a known type."""
    if not fields or depth >= _DEPTH:
        yield above, ""
        return
    if isinstance(fields, ItemFields):
        above = f"{above}[0]"
    for name, child in fields.items():
        yield from message_paths(child, f"{above}.{name}", depth + 1)


def _kind(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, int | float):
        return "number"
    if isinstance(value, str):
        return "text"
    if isinstance(value, bytes | bytearray):
        return "bytes"
    return "map" if isinstance(value, Mapping) else "list"


_SAMPLES = 512
"""Maximum number of messages of a key that are inspected, spread evenly."""
_BYTES = 64 << 20
"""Maximum number of bytes of samples kept for a key."""


@dataclass(slots=True)
class Topic:
    """The messages of one key. Times are nanoseconds since the epoch."""

    key: str
    recorded_as: str
    """The encoding in the recording."""
    type: str | None
    decode: Callable[[bytes], object] | None
    layout: Layout = Layout.PLAIN
    """The layout of the key on the network."""
    count: int = 0
    gap: int = 0
    """The longest time between two messages of one recording."""
    gap_time: int = 0
    """When that time begins."""
    samples: list[bytes] = field(default_factory=list)
    _last: int | None = None
    """The previous message of the same recording."""
    _lasted: int = 0
    _intervals: int = 0
    _stride: int = 1
    _bytes: int = 0

    def begin(self) -> None:
        """Start the next recording."""
        self._last = None

    def add(self, time: int, payload: bytes) -> None:
        """Add a message."""
        if self.count % self._stride == 0 and self._bytes < _BYTES:
            self.samples.append(payload)
            self._bytes += len(payload)
            if len(self.samples) >= _SAMPLES:
                del self.samples[1::2]
                self._stride *= 2
                self._bytes = sum(map(len, self.samples))
        self.count += 1
        if self._last is not None:
            self._lasted += time - self._last
            self._intervals += 1
            if time - self._last > self.gap:
                self.gap, self.gap_time = time - self._last, self._last
        self._last = time

    @property
    def rate(self) -> float | None:
        """Messages per second; None if there are fewer than two."""
        return self._intervals * 1e9 / self._lasted if self._lasted else None


@dataclass(frozen=True, slots=True)
class SurveyResult:
    """The result for some recordings."""

    topics: Sequence[Topic]
    """In order of their keys."""
    cuts: Sequence[Truncation]


def survey(recordings: Iterable[Recording]) -> SurveyResult:
    """Survey recordings, each a sequence of files. Raises RecordingError."""
    topics: dict[tuple[str, str, str | None], Topic] = {}
    cuts: list[Truncation] = []
    for recording in recordings:
        for topic in topics.values():
            topic.begin()
        by_channel: dict[Channel, Topic] = {}
        for batch in open_recordings(recording, on_cut=cuts.append):
            _add(batch, topics, by_channel)
    return SurveyResult([topics[at] for at in sorted(topics, key=str)], cuts)


def _add(batch: Batch, topics: dict[tuple[str, str, str | None], Topic], by_channel: dict[Channel, Topic]) -> None:
    for time, channel, payload in zip(batch.times, batch.channels, batch.payloads, strict=True):
        topic = by_channel.get(channel)
        if topic is None:
            at = channel.key, channel.encoding, channel.type
            topic = by_channel[channel] = topics.setdefault(at, Topic(*at, channel.decode))
        topic.add(time, payload)


def encoding_of(topic: Topic) -> Encoding:
    """The encoding of a stream for the topic: as recorded, else guessed from its samples."""
    if topic.decode is not None:
        return Encoding.JSON
    if topic.recorded_as in {each.value for each in Encoding} - {Encoding.RAW.value}:
        return Encoding(topic.recorded_as)
    return next((each for each in (Encoding.JSON, Encoding.CBOR) if topic_shape(topic, each) is not None), Encoding.RAW)


def topic_shape(topic: Topic, encoding: Encoding | None = None) -> MessageShape | None:
    """The shape of its samples; None if one does not have that encoding, or if the encoding has no plain values."""
    encoding = encoding or encoding_of(topic)
    if encoding not in (Encoding.JSON, Encoding.CBOR):
        return None
    shape = MessageShape()
    for value in _values(topic, encoding):
        if value is _UNREADABLE:
            return None
        shape.add(value)
    if encoding is Encoding.CBOR and topic.recorded_as != encoding.value and "map" not in shape.kinds:
        return None  # a byte or two of anything may be a number in CBOR
    return shape if shape.kinds else None


_UNREADABLE = object()


def _values(topic: Topic, encoding: Encoding) -> Iterator[object]:
    cbor = CborDecoder()
    for payload in topic.samples:
        try:
            if topic.decode is not None:
                yield topic.decode(payload)
            elif encoding is Encoding.JSON:
                yield msgspec.json.decode(payload)
            else:
                yield cbor.decode(payload)
        except (ValueError, DecodeError, RecursionError):
            yield _UNREADABLE
