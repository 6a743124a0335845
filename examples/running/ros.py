"""ROS 2 messages as CDR, for scenarios that send them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from examples.running.scenario import SECOND, START_NS, Message

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


def make(name: str, /, **fields: Any) -> Any:
    """A message of a type such as `geometry_msgs/msg/Point`; all its fields are given."""
    return TYPESTORE.types[name](**fields)


def header(after_ns: int, frame: str) -> Any:
    """A std_msgs/msg/Header with the stamp of that moment."""
    seconds, nanoseconds = divmod(START_NS + after_ns, SECOND)
    return make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds),
                frame_id=frame)  # fmt: skip


def ros_message(after_ns: int, key: str, name: str, message: Any) -> Message:
    """The message as it is sent."""
    return Message(after_ns, key, bytes(TYPESTORE.serialize_cdr(message, name)), "cdr", name)


POINTS = "sensor_msgs/msg/PointCloud2"


def cloud(after_ns: int, key: str, frame: str, points: NDArray[np.float64]) -> Message:
    """A sensor_msgs/msg/PointCloud2 as it is sent; points are x, y, z in metres and an intensity, shape (n, 4)."""
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * index, datatype=7, count=1)  # 7: 32-bit float
        for index, name in enumerate(("x", "y", "z", "intensity"))
    ]
    data = points.astype("<f4").reshape(-1).view(np.uint8)
    message = make(
        POINTS, header=header(after_ns, frame), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=16, row_step=16 * len(points), data=data, is_dense=True,
    )  # fmt: skip
    return ros_message(after_ns, key, POINTS, message)
