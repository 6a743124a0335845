"""The ROS 2 message types that are known, and how their text reads."""

from __future__ import annotations

import difflib
from functools import cache

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

HEADER = "std_msgs/msg/Header"


@cache
def typestore() -> Typestore:
    """All message types of the newest long-term ROS 2 release."""
    return get_typestore(Stores.ROS2_JAZZY)


class UnknownTypeError(ValueError):
    """A ROS 2 message type that the store does not hold; the text offers what may have been meant."""

    def __init__(self, name: str, field: str | None = None) -> None:
        """`field` is where the name was given."""
        close = difflib.get_close_matches(name, typestore().fielddefs, n=3)
        remedy = f"did you mean {' or '.join(close)}?" if close else "only the common ROS 2 messages are known"
        where = f"{field}: " if field else ""
        super().__init__(f"{where}unknown message type {name!r}: {remedy}")


def known(name: str) -> bool:
    """Whether the type, e.g. geometry_msgs/msg/PoseStamped, is known."""
    return name in typestore().fielddefs


@cache
def has_header(name: str) -> bool:
    """Whether the message begins with a std_msgs/msg/Header, so that its stamp is always at the same place."""
    fields = typestore().fielddefs[name][1]
    return bool(fields) and fields[0][1][1] == HEADER


@cache
def definition(name: str) -> str:
    """The type and all that it refers to as ros2msg text, as recordings carry it. Raises UnknownTypeError."""
    if not known(name):
        raise UnknownTypeError(name)
    return typestore().generate_msgdef(name, ros_version=2)[0]
