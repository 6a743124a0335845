"""A recorded message, and what else recordings tell."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

Wanted = Callable[[str], bool]
"""Whether messages on that key are asked for: what is not is passed over without being read, where the format can."""


class Message(NamedTuple):
    """One recorded message."""

    time: int
    """When it was recorded, in nanoseconds since the epoch."""
    key: str
    """Its Zenoh key: of a ROS topic, the name without its leading slash."""
    payload: bytes
    """The message as it was recorded."""
    encoding: str
    """As MCAP names it: cdr, json, ros1 and others."""
    type: str | None
    """The message type, e.g. geometry_msgs/msg/PoseStamped, where the recording tells it."""
    decode: Callable[[bytes], object] | None = None
    """Makes plain values of the payload, where the recording alone says how: Protobuf."""


class RecordedType(NamedTuple):
    """What a recording says of a message type."""

    name: str
    text: str
    """Its definition with all that it refers to; empty where the recording has none."""
    idl: bool
    """Whether the text is IDL; else it is as in a .msg file."""


class Cut(NamedTuple):
    """A recording whose end is missing, since its recorder was killed or the file was not copied whole."""

    path: Path
    messages: int
    """How many of the wanted messages were read up to there."""
    reason: str

    def __str__(self) -> str:
        return f"{self.path}: the recording is cut ({self.reason}): {self.messages} messages are read up to there"


OnCut = Callable[[Cut], None]
"""Told when the reading of a recording ends at a cut."""


def ignore(cut: Cut) -> None:
    """For those who read a recording a second time."""


class Piece(NamedTuple):
    """Messages that lie together in a file, none of them earlier than `start` (nanoseconds)."""

    start: int
    read: Callable[[], Iterable[Message]]


def messages_in_order(pieces: Iterable[Piece]) -> Iterator[Message]:
    """The messages of all pieces in the order of their times, those of equal times as they lie in the file.

    The pieces are given in that order. Each is read when its start is reached, so no more of them are in memory than
    overlap.
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
