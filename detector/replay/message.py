"""A recorded message, and other contents of recordings."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from wayside.inputerror import InputError


class RecordingError(InputError, ValueError):
    """A recording that cannot be read or does not fit the Detector; the text names the place and the remedy."""


DAMAGE = (
    AssertionError,
    LookupError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,  # what lz4 raises
    TypeError,
    ValueError,
    struct.error,
)
"""Exceptions of parsers of binary files for unexpected bytes, beside their own. Caught only around the reading of a
file, in which any byte may be damaged."""


Wanted = Callable[[str], bool]
"""Whether messages on that key are wanted: others are skipped without being read, if the format allows."""


class Message(NamedTuple):
    """One recorded message."""

    time: int
    """When it was recorded, in nanoseconds since the epoch."""
    key: str
    """Its Zenoh key; for a ROS topic, the name without its leading slash."""
    payload: bytes
    """The message as it was recorded."""
    encoding: str
    """MCAP's name of the encoding: cdr, json, ros1 and others."""
    type: str | None
    """The message type, e.g. geometry_msgs/msg/PoseStamped, if the recording contains it."""
    decode: Callable[[bytes], object] | None = None
    """Decodes the payload to plain values, if this needs the recording's definitions: Protobuf."""


class RecordedType(NamedTuple):
    """A recording's definition of a message type."""

    name: str
    text: str
    """The definition with all types that it refers to; empty if the recording has none."""
    idl: bool
    """Whether the text is IDL; otherwise it is in the form of a .msg file."""


class Truncation(NamedTuple):
    """A truncated recording: its recorder was killed, or the file was not copied completely."""

    path: Path
    messages: int
    """Number of wanted messages that were read up to there."""
    reason: str

    def __str__(self) -> str:
        return f"{self.path}: the recording is cut ({self.reason}): it contains {self.messages} messages up to there"


OnCut = Callable[[Truncation], None]
"""Called when the reading of a recording ends at a cut."""


def ignore(cut: Truncation) -> None:
    """For a second pass over a recording."""


class Piece(NamedTuple):
    """Messages that are stored together in a file, none earlier than `start` (nanoseconds)."""

    start: int
    read: Callable[[], Iterable[Message]]


def messages_in_order(pieces: Iterable[Piece]) -> Iterator[Message]:
    """The messages of all pieces in time order; equal times in the order of the file.

    The pieces are given in that order. Each is read when its start is reached, so only overlapping ones are in memory.
    """
    waiting: list[tuple[int, int, int, Message]] = []
    for place, piece in sorted(enumerate(pieces), key=lambda each: (each[1].start, each[0])):
        while waiting and waiting[0][:2] < (piece.start, place):
            yield heapq.heappop(waiting)[-1]
        for number, message in enumerate(piece.read()):
            heapq.heappush(waiting, (message.time, place, number, message))
    while waiting:
        yield heapq.heappop(waiting)[-1]


def topic_key(topic: str) -> str:
    """The key of a ROS topic."""
    return topic.removeprefix("/")
