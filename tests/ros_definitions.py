"""Writes the fields of the standard ROS 2 messages, as rosbags knows them, in the form that the detector reads.

python -m tests.ros_definitions > detector/streams/codecs/jazzy.json
"""

from __future__ import annotations

import json
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore


def text() -> str:
    """All types of the release, each on one line: its fields with their types."""
    types = get_typestore(Stores.ROS2_JAZZY).fielddefs
    lines = (
        f"{json.dumps(name)}: {json.dumps({field: type_text(desc) for field, desc in fields})}"
        for name, (_, fields) in sorted(types.items())
    )
    return "{\n" + ",\n".join(lines) + "\n}\n"


def type_text(desc: Any) -> str:
    """A field's type: `float64`, `string<=16`, `geometry_msgs/msg/Point[2]`, `uint8[]`, `uint8[<=4]`."""
    kind, detail = desc
    if kind is Nodetype.NAME:
        return str(detail)
    if kind is Nodetype.BASE:
        name, limit = detail
        return f"{name}<={limit}" if limit else str(name)
    element, count = detail
    bound = str(count) if kind is Nodetype.ARRAY else f"<={count}" if count else ""
    return f"{type_text(element)}[{bound}]"


if __name__ == "__main__":
    print(text(), end="")
