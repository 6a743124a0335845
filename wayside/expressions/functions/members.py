"""Reads numbers from function arguments: maps, records of decoded messages, lists of coordinates.

An absent, null or NaN value raises ValueError with a message that begins with `no value for`, which means unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

_ABSENT: Final = object()

_PLACES: Final = (("position",), ("pose", "position"), ("pose", "pose", "position"), ("center", "position"))
"""The possible paths of an object's coordinates, if these are not in the object itself."""

Place = tuple[float, float, float]
"""Metres along x, y and z."""


def sequence(value: object, what: str) -> Sequence[object]:
    """The value as a list or tuple, also from a numpy array."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return value
    raise ValueError(f"{what} must be a list")


def number(value: object, what: str) -> float:
    """The value as a double."""
    if value is None or value is _ABSENT or value != value:  # noqa: PLR0124 (NaN alone differs from itself)
        raise ValueError(f"no value for {what}")
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        raise ValueError(f"{what} must be a number")
    return float(value)


def member(value: object, name: str) -> object:
    """The field of a map or a record; a sentinel if it does not exist."""
    if isinstance(value, Mapping):
        return value.get(name, _ABSENT)
    return getattr(value, name, _ABSENT) if hasattr(value, "__dataclass_fields__") else _ABSENT


def pair(point: object, names: tuple[str, str], what: str) -> tuple[float, float]:
    """Two coordinates, from a list of two numbers, or from a map with these names."""
    if isinstance(point, list | tuple):
        if len(point) < 2:
            raise ValueError(f"{what} must have two numbers; got {len(point)}")
        return number(point[0], f"{what}[0]"), number(point[1], f"{what}[1]")
    first, second = (number(member(point, name), f"{what}.{name}") for name in names)
    return first, second


def place(item: object, what: str, path: str = "") -> Place:
    """The position of an object: at `path` (such as `bbox.center.position`), or in one of the usual fields.

    That is x, y and z (0 where absent) of the object itself, of its position, pose.position, pose.pose.position or
    center.position; or a list of two or three numbers.
    """
    at = item
    if path:
        for name in path.split("."):
            at = member(at, name)
            if at is _ABSENT or at is None:
                raise ValueError(f"no value for {path} of {what}")
    if isinstance(at, list | tuple):
        x, y = pair(at, ("x", "y"), what)
        return x, y, number(at[2], f"{what}[2]") if len(at) > 2 else 0.0
    if not path and member(at, "x") is _ABSENT:
        at = next((found for steps in _PLACES if (found := _below(item, steps)) is not _ABSENT), item)
    z = member(at, "z")
    x, y = pair(at, ("x", "y"), what)
    return x, y, 0.0 if z is _ABSENT or z is None else number(z, f"{what}.z")


def _below(item: object, steps: tuple[str, ...]) -> object:
    for step in steps:
        item = member(item, step)
        if item is _ABSENT or item is None:
            return _ABSENT
    return item
