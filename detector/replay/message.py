"""What every kind of recording is read into."""

from __future__ import annotations

from collections.abc import Callable
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


class RecordedType(NamedTuple):
    """What a recording says of a message type."""

    name: str
    text: str
    """Its definition with all that it refers to; empty where the recording has none."""
    idl: bool
    """Whether the text is IDL; else it is as in a .msg file."""


def key_of(topic: str) -> str:
    """The key of a ROS topic."""
    return topic.removeprefix("/")
