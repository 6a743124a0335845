"""What `at(position, place)` and `seenFrom(a, b)` come to: a function of numbers for each of their fields.

Authors write the field (`at(position, "crossing").inside`), and `expanding` makes a call of it. Headings are degrees
counter-clockwise here, yaws radians counter-clockwise; turns are degrees, positive to the left.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from wayside import geodesy
from wayside.expressions.functions.declaring import Yields, function
from wayside.geometry import Bools, Doubles, Shape, shape_of

Placed = Callable[..., Doubles]
"""Of a shape and columns of numbers."""


def turn(start: Doubles, end: Doubles) -> Doubles:
    """The turn from one direction to another, degrees in (-180, 180], positive to the left."""
    by = np.remainder(end - start, 360.0)
    return np.where(by > 180.0, by - 360.0, by)


def _inside(shape: Shape, u: Doubles, v: Doubles) -> Doubles:
    return shape.inside(u, v).astype(np.float64)


def _heading(shape: Shape, u: Doubles, v: Doubles, heading: Doubles) -> Doubles:
    return turn(shape.arc(u, v).direction, heading)


OF_PLACES: Final[dict[str, tuple[Placed, str]]] = {
    "at_inside": (_inside, "u v place:text"),
    "at_distance": (Shape.distance, "u v place:text"),
    "at_along": (lambda shape, u, v: shape.arc(u, v).along, "u v place:text"),
    "at_across": (lambda shape, u, v: shape.arc(u, v).across, "u v place:text"),
    "at_heading": (_heading, "u v heading place:text"),
}
"""By name: over columns, and the parameters."""


def allowed(shape: Shape, u: Doubles, v: Doubles, *heading: Doubles) -> Bools:
    """Where there is an answer at all."""
    found = shape.allows(u, v)
    for each in heading:
        found = found & np.isfinite(each)
    return found


def _alone(calculate: Placed) -> Callable[..., float]:
    """The same for one position."""

    def calculated(*given: object) -> float:
        *numbers, key = given
        shape = shape_of(str(key))
        columns = [np.array([number], np.float64) for number in numbers]
        if not allowed(shape, *columns)[0]:
            raise ValueError(f"{', '.join(f'{number:g}' for number in numbers)} is no position at {shape.name}")
        return float(calculate(shape, *columns)[0])

    return calculated


def _ahead(x: float, y: float, yaw: float, other_x: float, other_y: float) -> float:
    dx, dy = other_x - x, other_y - y
    return _finite(dx * math.cos(yaw) + dy * math.sin(yaw))


def _left(x: float, y: float, yaw: float, other_x: float, other_y: float) -> float:
    dx, dy = other_x - x, other_y - y
    return _finite(dy * math.cos(yaw) - dx * math.sin(yaw))


def _ahead_wgs84(latitude: float, longitude: float, yaw: float, other_lat: float, other_lon: float) -> float:
    return _ahead(0.0, 0.0, yaw, *_metres(latitude, longitude, other_lat, other_lon))


def _left_wgs84(latitude: float, longitude: float, yaw: float, other_lat: float, other_lon: float) -> float:
    return _left(0.0, 0.0, yaw, *_metres(latitude, longitude, other_lat, other_lon))


def _speed_ahead(yaw: float, speed: float, other_yaw: float, other_speed: float) -> float:
    return _finite(other_speed * math.cos(other_yaw - yaw) - speed)


def _speed_left(yaw: float, speed: float, other_yaw: float, other_speed: float) -> float:
    return _finite(other_speed * math.sin(other_yaw - yaw) + 0.0 * speed)


def _turned(yaw: float, other_yaw: float) -> float:
    by = math.degrees(_finite(other_yaw - yaw)) % 360.0
    return by - 360.0 if by > 180.0 else by


def _metres(latitude: float, longitude: float, other_latitude: float, other_longitude: float) -> tuple[float, float]:
    """East and north, on the ellipsoid halfway between the two."""
    north, east = geodesy.degrees((latitude + other_latitude) / 2)
    return math.remainder(other_longitude - longitude, 360.0) * east, (other_latitude - latitude) * north


def _finite(number: float) -> float:
    if not math.isfinite(number):
        raise ValueError("a position, yaw or speed is infinite")
    return number


_SEEN = "u v yaw other_u other_v"

FUNCTIONS = (
    *(
        function(name, Yields.NUMBER, "at", (_alone(calculate), parameters))
        for name, (calculate, parameters) in OF_PLACES.items()
    ),
    function("seen_ahead", Yields.NUMBER, "seenFrom", (_ahead, _SEEN)),
    function("seen_left", Yields.NUMBER, "seenFrom", (_left, _SEEN)),
    function("seen_aheadWgs84", Yields.NUMBER, "seenFrom", (_ahead_wgs84, _SEEN)),
    function("seen_leftWgs84", Yields.NUMBER, "seenFrom", (_left_wgs84, _SEEN)),
    function("seen_speedAhead", Yields.NUMBER, "seenFrom", (_speed_ahead, "yaw speed other_yaw other_speed")),
    function("seen_speedLeft", Yields.NUMBER, "seenFrom", (_speed_left, "yaw speed other_yaw other_speed")),
    function("seen_heading", Yields.NUMBER, "seenFrom", (_turned, "yaw other_yaw")),
)
