"""Poses in messages: of geometry_msgs and nav_msgs, or of any map with a position and an orientation."""

from __future__ import annotations

import math
from typing import Any

from detector.engine.queries.geometry import IDENTITY, Pose, unit


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
