"""ROS 2 messages for tests, made and serialised by rosbags."""

from typing import Any

import numpy as np

from detector.streams.codecs.ros import standard


def make(type_name: str, **fields: Any) -> Any:
    """A message object; the short type name `geometry_msgs/Point` means `geometry_msgs/msg/Point`."""
    return standard().store.types[type_name.replace("/", "/msg/")](**fields)


def cdr(message: Any, *, little_endian: bool = True) -> bytes:
    """The message as ROS 2 puts it on the wire."""
    return bytes(standard().store.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def header(seconds: int = 5, nanoseconds: int = 7, frame_id: str = "map") -> Any:
    stamp = make("builtin_interfaces/Time", sec=seconds, nanosec=nanoseconds)
    return make("std_msgs/Header", stamp=stamp, frame_id=frame_id)


def pose(x: float = 1.0, y: float = 2.0) -> Any:
    return make(
        "geometry_msgs/Pose",
        position=make("geometry_msgs/Point", x=x, y=y, z=0.0),
        orientation=make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )


def pose_stamped(x: float = 1.0, y: float = 2.0, **header_fields: Any) -> Any:
    return make("geometry_msgs/PoseStamped", header=header(**header_fields), pose=pose(x, y))


def odometry() -> Any:
    vector = make("geometry_msgs/Vector3", x=1.0, y=2.0, z=3.0)
    twist = make("geometry_msgs/Twist", linear=vector, angular=vector)
    return make(
        "nav_msgs/Odometry",
        header=header(),
        child_frame_id="base",
        pose=make("geometry_msgs/PoseWithCovariance", pose=pose(), covariance=np.arange(36.0)),
        twist=make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def point_cloud(points: int = 10) -> Any:
    fields = [
        make("sensor_msgs/PointField", name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate("xyz")
    ]
    return make(
        "sensor_msgs/PointCloud2",
        header=header(),
        height=1,
        width=points,
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * points,
        data=np.arange(12 * points, dtype=np.uint8),
        is_dense=True,
    )
