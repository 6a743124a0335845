"""The drive as the vehicles' messages: what is sent when, under which key, as CDR.

Every vehicle sends its pose ten times a second, the lidar vehicles also a small point cloud twice a second. Each
vehicle has its own phase, so that fifteen poses do not come in one burst. The same drive gives the same bytes.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from rosbags.typesys import Stores, get_typestore

from cooperative_recording.vehicles import VEHICLES, Drive, Pose, Vehicle

if TYPE_CHECKING:
    from rosbags.typesys.store import Msg

POSE_TYPE = "geometry_msgs/msg/PoseStamped"
POSE_PERIOD_NS = 100_000_000
POINTS_TYPE = "sensor_msgs/msg/PointCloud2"
POINTS_PERIOD_NS = 500_000_000
POINTS = 300
"""Points of a cloud, each x, y, z and intensity as 32-bit floats: 16 bytes."""

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
_TYPES = TYPESTORE.types
_Time, _Header = _TYPES["builtin_interfaces/msg/Time"], _TYPES["std_msgs/msg/Header"]
_Point, _Quaternion = _TYPES["geometry_msgs/msg/Point"], _TYPES["geometry_msgs/msg/Quaternion"]
_Pose, _PoseStamped = _TYPES["geometry_msgs/msg/Pose"], _TYPES[POSE_TYPE]
_PointField, _PointCloud2 = _TYPES["sensor_msgs/msg/PointField"], _TYPES[POINTS_TYPE]
_FIELDS = [_PointField(name, 4 * index, 7, 1) for index, name in enumerate(("x", "y", "z", "intensity"))]  # 7: float32


@dataclass(frozen=True, slots=True)
class Message:
    """One message: after_ns since the drive's start it is sent under the Zenoh key; its stamp is that moment."""

    after_ns: int
    key: str
    type: str
    payload: bytes


def messages(drive: Drive, start_ns: int, duration_s: float) -> Iterator[Message]:
    """All messages of the drive's first duration_s seconds, in order of time.

    start_ns is what the drive's second 0 is called in the stamps, in nanoseconds since the epoch.
    """
    yield from heapq.merge(
        *(_of_vehicle(drive, number, start_ns, duration_s) for number in range(len(VEHICLES))),
        key=lambda message: message.after_ns,
    )


def keys() -> list[str]:
    """All keys that messages are sent under, sorted."""
    poses = [pose_key(vehicle) for vehicle in VEHICLES]
    return sorted(poses + [points_key(vehicle) for vehicle in VEHICLES if vehicle.lidar])


def pose_key(vehicle: Vehicle) -> str:
    """The Zenoh key of the vehicle's poses."""
    return f"vehicles/{vehicle.name}/pose"


def points_key(vehicle: Vehicle) -> str:
    """The Zenoh key of the lidar vehicle's point clouds."""
    return f"vehicles/{vehicle.name}/points"


def pose_payload(pose: Pose, stamp_ns: int) -> bytes:
    """A geometry_msgs/msg/PoseStamped in the frame "map", as CDR."""
    turn = _Quaternion(0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2))
    message = _PoseStamped(_header(stamp_ns, "map"), _Pose(_Point(pose.x, pose.y, pose.z), turn))
    return bytes(TYPESTORE.serialize_cdr(message, POSE_TYPE))


def points_payload(vehicle: Vehicle, seed: int, number: int, stamp_ns: int) -> bytes:
    """The vehicle's cloud of that number, a sensor_msgs/msg/PointCloud2 in its lidar's own frame, as CDR."""
    rng = np.random.default_rng([seed, VEHICLES.index(vehicle), number])
    bearing, distance = rng.uniform(-math.pi, math.pi, POINTS), rng.gamma(3.0, 8.0, POINTS)
    height = rng.uniform(-1.8, 3.0, POINTS)
    cloud = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), height, rng.uniform(0, 1, POINTS)])
    data = cloud.astype("<f4").reshape(-1).view(np.uint8)
    header = _header(stamp_ns, f"{vehicle.name}/lidar")
    message = _PointCloud2(header, 1, POINTS, _FIELDS, False, 16, 16 * POINTS, data, True)
    return bytes(TYPESTORE.serialize_cdr(message, POINTS_TYPE))


def _of_vehicle(drive: Drive, number: int, start_ns: int, duration_s: float) -> Iterator[Message]:
    vehicle = VEHICLES[number]
    first = number * POSE_PERIOD_NS // len(VEHICLES)
    moments = np.arange(first, round(duration_s * 1e9), POSE_PERIOD_NS, dtype=np.int64)
    poses = drive.poses(vehicle.name, moments / 1e9)
    for after, (x, y, yaw) in zip(moments.tolist(), poses.tolist(), strict=True):
        stamp = start_ns + after
        yield Message(after, pose_key(vehicle), POSE_TYPE, pose_payload(Pose(x, y, 0.0, yaw), stamp))
        cloud, rest = divmod(after - first, POINTS_PERIOD_NS)
        if vehicle.lidar and rest == 0:
            payload = points_payload(vehicle, drive.seed, cloud, stamp)
            yield Message(after, points_key(vehicle), POINTS_TYPE, payload)


def _header(stamp_ns: int, frame: str) -> Msg:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return _Header(_Time(seconds, nanoseconds), frame)
