"""Angles: of quaternions in radians, as in ROS, and between headings in degrees, as in GNSS and ETSI messages.

Yaw, pitch and roll are those of REP 103: rotations about z, then y, then x, right-handed.
"""

from __future__ import annotations

import math

from wayside.expressions.functions.declaring import ResultType, function
from wayside.expressions.functions.members import member, number

Quaternion = tuple[float, float, float, float]
"""x, y, z, w; of length 1."""


def heading_difference(start: float, end: float) -> float:
    """The turn from one heading to another in degrees, in (-180, 180]."""
    return _wrapped(_finite(end, "to") % 360.0 - _finite(start, "from") % 360.0, 360.0)


def angle_difference(start: float, end: float) -> float:
    """The turn from one angle to another in radians, in (-pi, pi]."""
    return _wrapped(_finite(end, "to") % math.tau - _finite(start, "from") % math.tau, math.tau)


def yaw(*quaternion: object) -> float:
    """The rotation about z in radians, in [-pi, pi]."""
    x, y, z, w = _quaternion(quaternion)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def pitch(*quaternion: object) -> float:
    """The rotation about y in radians, in [-pi/2, pi/2]."""
    x, y, z, w = _quaternion(quaternion)
    return math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))


def roll(*quaternion: object) -> float:
    """The rotation about x in radians, in [-pi, pi]."""
    x, y, z, w = _quaternion(quaternion)
    return math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))


def _wrapped(difference: float, whole: float) -> float:
    if difference > whole / 2:
        return difference - whole
    return difference + whole if difference <= -whole / 2 else difference


def _finite(angle: float, what: str) -> float:
    if math.isinf(angle):
        raise ValueError(f"{what} is infinite: give a finite angle")
    return angle


def _quaternion(arguments: tuple[object, ...]) -> Quaternion:
    """The normalised quaternion, from a map with x, y, z and w, or from four numbers."""
    parts = arguments if len(arguments) == 4 else tuple(member(arguments[0], name) for name in "xyzw")
    x, y, z, w = (number(part, f"{name} of the quaternion") for name, part in zip("xyzw", parts, strict=True))
    length = math.hypot(x, y, z, w)
    if length == 0 or math.isinf(length):
        raise ValueError(f"the length of the quaternion must be finite and above 0; got {length:g}")
    return x / length, y / length, z / length, w / length


_WAYS = "quaternion:map", "x y z w"

FUNCTIONS = (
    function(
        "headingDifference",
        ResultType.NUMBER,
        "the turn from one heading to another, degrees in (-180, 180]; compass headings: positive to the right",
        (heading_difference, "from to"),
    ),
    function(
        "angleDifference",
        ResultType.NUMBER,
        "the turn from one angle to another, radians in (-π, π]; counter-clockwise angles: positive to the left",
        (angle_difference, "from to"),
    ),
    function("yaw", ResultType.NUMBER, "rotation about z, radians in [-π, π]", *((yaw, way) for way in _WAYS)),
    function("pitch", ResultType.NUMBER, "rotation about y, radians in [-π/2, π/2]", *((pitch, way) for way in _WAYS)),
    function("roll", ResultType.NUMBER, "rotation about x, radians in [-π, π]", *((roll, way) for way in _WAYS)),
    function("degrees", ResultType.NUMBER, "radians converted to degrees", (math.degrees, "radians")),
    function("radians", ResultType.NUMBER, "degrees converted to radians", (math.radians, "degrees")),
)
