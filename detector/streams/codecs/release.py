"""The fields of the standard ROS 2 messages, from a file: rosbags creates the classes of all types to know them."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Any, cast

import msgspec
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

MessageFields = list[tuple[str, FieldDesc]]
"""The fields of a message in their order."""

_FILE = "jazzy.json"
"""Written by `python -m tests.ros_definitions`."""
_FIELD = re.compile(r"(?P<name>[\w/]+)(?:<=(?P<limit>\d+))?(?:\[(?P<most><=)?(?P<count>\d*)\])?")


def release_fields() -> dict[str, MessageFields]:
    """The fields of each type of the release, in rosbags' form."""
    written = msgspec.json.decode(files(__package__).joinpath(_FILE).read_bytes(), type=dict[str, dict[str, str]])
    described: dict[str, FieldDesc] = {}
    for each in {text for fields in written.values() for text in fields.values()}:
        described[each] = _described(each)
    return {name: [(field, described[text]) for field, text in fields.items()] for name, fields in written.items()}


def _described(text: str) -> FieldDesc:
    """A field's type: `float64`, `string<=16`, `geometry_msgs/msg/Point[2]`, `uint8[]`, `uint8[<=4]`."""
    match = _FIELD.fullmatch(text)
    assert match is not None  # noqa: S101  a test compares the file with rosbags
    name, count = match["name"], match["count"]
    element: Any = (Nodetype.NAME, name) if "/" in name else (Nodetype.BASE, (name, int(match["limit"] or 0)))
    if count is None:
        return cast("FieldDesc", element)
    kind = Nodetype.ARRAY if count and not match["most"] else Nodetype.SEQUENCE
    return cast("FieldDesc", (kind, (element, int(count or 0))))
