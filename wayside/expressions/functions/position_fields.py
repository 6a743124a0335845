"""The fields of `at(position, place)` and `seenFrom(a, b)`, each as a function of plain numbers.

Authors write a field (`at(position, "crossing").inside`), and `expanding` turns it into a call. Headings are here in
degrees counter-clockwise, yaws in radians counter-clockwise; turns are in degrees, positive to the left.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from wayside.expressions.functions.declaring import ResultType, function
from wayside.geo import geodesy

OF_PLACES: Final = {
    "at_inside": "u v place:string",
    "at_distance": "u v place:string",
    "at_along": "u v place:string",
    "at_across": "u v place:string",
    "at_heading": "u v heading place:string",
}
"""The parameters of the functions that `geo.positions` computes, by name."""


def _at(name: str) -> Callable[..., float]:
    def calculated(*given: object) -> float:
        from wayside.geo.positions import at_one  # noqa: PLC0415  numpy is loaded only for an evaluation

        *numbers, key = given
        return at_one(name, str(key), *numbers)  # type: ignore[arg-type]  # CEL has checked the types

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
    """The metres to the east and north, on the ellipsoid at the mean latitude."""
    north, east = geodesy.degrees((latitude + other_latitude) / 2)
    return math.remainder(other_longitude - longitude, 360.0) * east, (other_latitude - latitude) * north


def _finite(number: float) -> float:
    if not math.isfinite(number):
        raise ValueError("the position, yaw and speed must be finite")
    return number


_SEEN = "u v yaw other_u other_v"

FUNCTIONS = (
    *(function(name, ResultType.NUMBER, "at", (_at(name), parameters)) for name, parameters in OF_PLACES.items()),
    function("seen_ahead", ResultType.NUMBER, "seenFrom", (_ahead, _SEEN)),
    function("seen_left", ResultType.NUMBER, "seenFrom", (_left, _SEEN)),
    function("seen_aheadWgs84", ResultType.NUMBER, "seenFrom", (_ahead_wgs84, _SEEN)),
    function("seen_leftWgs84", ResultType.NUMBER, "seenFrom", (_left_wgs84, _SEEN)),
    function("seen_speedAhead", ResultType.NUMBER, "seenFrom", (_speed_ahead, "yaw speed other_yaw other_speed")),
    function("seen_speedLeft", ResultType.NUMBER, "seenFrom", (_speed_left, "yaw speed other_yaw other_speed")),
    function("seen_heading", ResultType.NUMBER, "seenFrom", (_turned, "yaw other_yaw")),
)
