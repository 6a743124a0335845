"""Poses in messages, rotations and rigid transforms. Quaternions are (x, y, z, w), lengths are metres."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)

_NEARLY_EQUAL = 1e-6
"""Angle in radians below which slerp would divide by almost zero: linear interpolation is precise enough there."""


class Pose(NamedTuple):
    """A position and an orientation in a reference frame; also the transform from its own frame into that one."""

    position: Vector
    """Metres."""
    orientation: Quaternion
    """Of unit length."""

    def apply(self, point: Vector) -> Vector:
        """Transform a point from the frame of this pose into the reference frame."""
        return _added(self.position, rotated(self.orientation, point))

    def after(self, other: Pose) -> Pose:
        """The composition: first `other`, then this one."""
        return Pose(self.apply(other.position), product(self.orientation, other.orientation))

    def inverse(self) -> Pose:
        """The inverse transform."""
        x, y, z, w = self.orientation
        back = (-x, -y, -z, w)
        px, py, pz = rotated(back, self.position)
        return Pose((-px, -py, -pz), back)

    def towards(self, other: Pose, share: float) -> Pose:
        """Between this pose (share 0) and another (1): the position on the line, the orientation by slerp."""
        place = tuple(a + (b - a) * share for a, b in zip(self.position, other.position, strict=True))
        return Pose((place[0], place[1], place[2]), slerp(self.orientation, other.orientation, share))


NO_MOTION = Pose((0.0, 0.0, 0.0), IDENTITY)


def unit(quaternion: Quaternion) -> Quaternion | None:
    """The quaternion at unit length; None if it is zero or not finite, and therefore no orientation."""
    length = math.hypot(*quaternion)
    if not 1e-6 < length < math.inf:
        return None
    x, y, z, w = quaternion
    return (x / length, y / length, z / length, w / length)


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """The composition: first b, then a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotated(quaternion: Quaternion, vector: Vector) -> Vector:
    """The vector, rotated by a quaternion of unit length."""
    x, y, z, w = quaternion
    vx, vy, vz = vector
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx)


def slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """On the shorter great circle from a (share 0) to b (1), at constant angular speed (Shoemake 1985)."""
    cosine = sum(p * q for p, q in zip(a, b, strict=True))
    sign = -1.0 if cosine < 0 else 1.0  # q and -q are the same orientation: use the nearer one
    # An arccosine would lose half of the digits of a small angle.
    angle = 2 * math.atan2(
        math.hypot(*(p - sign * q for p, q in zip(a, b, strict=True))),
        math.hypot(*(p + sign * q for p, q in zip(a, b, strict=True))),
    )
    if angle < _NEARLY_EQUAL:
        first, second = 1 - share, share * sign
    else:
        first, second = math.sin((1 - share) * angle), math.sin(share * angle) * sign
    mixed = tuple(p * first + q * second for p, q in zip(a, b, strict=True))
    return unit((mixed[0], mixed[1], mixed[2], mixed[3])) or a


def _added(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


class PoseError(ValueError):
    """A message has no pose at the path."""


def pose_in(message: Any, at: str = "") -> Pose:
    """The pose at a path such as `pose.pose`; without a path, at the places where ROS messages have it.

    A map with position (or translation) and orientation (or rotation); without an orientation it points along x. Raises
    PoseError.
    """
    here = _descended(message, at) if at else _found(message)
    place = here.get("position", here.get("translation")) if isinstance(here, dict) else None
    turn = here.get("orientation", here.get("rotation")) if isinstance(here, dict) else None
    if not isinstance(place, dict):
        raise PoseError(f"no pose {f'at {at!r}' if at else 'in the message'}: give its path with `at`")
    x, y, z = (_number(place, axis, 0.0 if axis == "z" else None) for axis in ("x", "y", "z"))
    if turn is None:
        return Pose((x, y, z), IDENTITY)
    if not isinstance(turn, dict):
        raise PoseError("the orientation is not a map of x, y, z, w")
    quaternion = unit((_number(turn, "x"), _number(turn, "y"), _number(turn, "z"), _number(turn, "w")))
    if quaternion is None:
        raise PoseError("the orientation is a quaternion of length zero")
    return Pose((x, y, z), quaternion)


def _found(message: Any) -> Any:
    here = message
    while isinstance(here, dict) and "position" not in here and "translation" not in here:
        here = here.get("pose", here.get("transform"))
    return here


def _descended(message: Any, path: str) -> Any:
    here = message
    for name in path.split("."):
        here = here.get(name) if isinstance(here, dict) else None
    return here


def _number(values: dict[str, Any], name: str, default: float | None = None) -> float:
    value = values.get(name, default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise PoseError(f"{name} of the pose is not a number: {value!r:.40}")
    return float(value)
