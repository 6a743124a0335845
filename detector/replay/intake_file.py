"""Intake files: the input of a detector's engine in its original order, so that the replay gives the same events.

An intake file is an MCAP file, so any MCAP tool opens it. A channel contains the messages of one stream and key as
received; its metadata names the stream. One more channel contains the controls: all other inputs of the engine. The
order in the file counts, not the order of the times.

A file replays with the defaults and the time order of its detector's version. Version 1: a stream becomes stale after
`clientTimeout`, and a position is known while its stream is not stale. Version 2: `staleAfter` is 5 s and `maxAge` of a
position 1 s by default; for the order, see `engine.timing.steps`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, DataEnd, Header, McapRecord, Message
from mcap.stream_reader import StreamReader

from detector.engine.samples.sample import Arrival
from detector.plugins.outages import KIND as OUTAGE
from detector.replay.message import DAMAGE, RecordingError
from wayside.rules import CompiledRule, PairSubject

LIBRARY = "wayside intake 1"
"""The text in the header that identifies an intake file; the number is the version of the contents."""
STREAM = "stream"
"""Metadata of a channel of messages: the stream's name."""
CONTROL_TOPIC = "wayside/intake"
_MAX_RECORD = 1 << 30

_DAMAGE = (*DAMAGE, McapError, zstandard.ZstdError)
"""All exceptions of the reader for a truncated or damaged file."""


class Control(NamedTuple):
    """Another input of the engine between arrivals."""

    time: int
    """Nanoseconds since the epoch."""
    document: dict[str, Any]
    """Its `kind`, and the fields of that kind. Written by the writer: `lost` (`arrivals`: how many are missing here
    because the disk was too slow); added by the reader: `cut` (`reason`: the file ends here without having been
    closed)."""

    @property
    def kind(self) -> str:
        """The kind of control."""
        return str(self.document.get("kind", ""))


def is_intake_file(path: Path) -> bool:
    """Whether the file is an intake file, complete or truncated. Raises OSError."""
    if path.is_dir():
        return False
    with path.open("rb") as file:
        try:
            first = next(StreamReader(file, record_size_limit=_MAX_RECORD).records)
        except (*_DAMAGE, StopIteration):
            return False
    return isinstance(first, Header) and first.library == LIBRARY


def read_intake(path: Path) -> Iterator[Arrival | Control]:
    """Arrivals and controls in their original order.

    A file that was not closed (kill -9) yields its readable part, then a control `cut`. Raises RecordingError if it is
    no intake file.
    """
    if not is_intake_file(path):
        raise RecordingError(f"{path}: not an intake file: give one that `detector run --record-intake` wrote")
    time = 0
    with path.open("rb") as file:
        channels: dict[int, Channel] = {}
        records = StreamReader(file, validate_crcs=True, record_size_limit=_MAX_RECORD).records
        while True:
            try:
                record: McapRecord = next(records)
                if isinstance(record, DataEnd):
                    return
                item = _item(record, channels)
            except StopIteration:
                return
            except _DAMAGE as error:
                yield Control(time, {"kind": "cut", "reason": str(error) or type(error).__name__})
                return
            if item is not None:
                time = item.time
                yield item


def recorded_outages(path: Path) -> Iterator[dict[str, Any]]:
    """The outages of plugins in the file. Raises RecordingError."""
    return (each.document for each in read_intake(path) if isinstance(each, Control) and each.kind == OUTAGE)


def _item(record: McapRecord, channels: dict[int, Channel]) -> Arrival | Control | None:
    if isinstance(record, Channel):
        channels[record.id] = record
    elif isinstance(record, Message):
        channel = channels[record.channel_id]
        stream = channel.metadata.get(STREAM)
        if stream is None:
            return Control(record.log_time, msgspec.json.decode(record.data, type=dict[str, Any]))
        return Arrival(record.log_time, stream, channel.topic, record.data)
    return None


_CLIENT_TIMEOUT = "30s"


def detector_as_of(document: dict[str, Any], version: int) -> dict[str, Any]:
    """A recorded Detector, with the defaults of its version written out."""
    if version > 1:
        return document
    spec = document["spec"]
    stale = spec.get("clientTimeout", _CLIENT_TIMEOUT)
    streams = [
        stream if stream.get("latched") or "staleAfter" in stream else {**stream, "staleAfter": stale}
        for stream in spec["streams"]
    ]
    return {**document, "spec": {**spec, "streams": streams}}


def rule_as_of(rule: CompiledRule, version: int) -> CompiledRule:
    """A recorded rule, evaluated as in its version."""
    if version > 1 or not isinstance(rule.subject, PairSubject):
        return rule
    position = replace(rule.subject.position, max_age_ns=None)
    return replace(rule, subject=replace(rule.subject, position=position))
