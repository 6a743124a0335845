"""Positions: distances in metres, bearings in degrees, and tests whether a position is inside a polygon.

Positions on the Earth refer to the ellipsoid WGS 84. The edges of a polygon in degrees are straight in latitude and
longitude. Edges of up to a few kilometres differ from straight lines on the ground by centimetres.
"""

from __future__ import annotations

import math

from wayside.expressions.functions.declaring import ResultType, function
from wayside.expressions.functions.members import pair, place, sequence
from wayside.geo import geodesy
from wayside.geo.geometry import Point, contains


def wgs84_distance(latitude1: float, longitude1: float, latitude2: float, longitude2: float) -> float:
    """The distance along the ellipsoid between two positions in degrees, in metres."""
    _check(latitude1, longitude1)
    _check(latitude2, longitude2)
    return geodesy.surface_distance(latitude1, longitude1, latitude2, longitude2)


def wgs84_bearing(latitude1: float, longitude1: float, latitude2: float, longitude2: float) -> float:
    """The initial bearing of the great circle, in degrees in [0, 360) clockwise from north.

    The error is up to 0.2 degrees.
    """
    _check(latitude1, longitude1)
    _check(latitude2, longitude2)
    phi1, phi2 = math.radians(latitude1), math.radians(latitude2)
    difference = math.radians(math.remainder(longitude2 - longitude1, 360.0))
    east = math.sin(difference) * math.cos(phi2)
    north = math.cos(phi1) * math.sin(phi2) - math.sin(phi1) * math.cos(phi2) * math.cos(difference)
    bearing = math.degrees(math.atan2(east, north)) % 360.0
    return 0.0 if bearing == 360.0 else bearing  # a bearing just below 0 is rounded to 360


def inside(x: float, y: float, polygon: object) -> bool:
    """Whether (x, y) is inside the polygon or on its edge; the polygon is a list of corners [x, y] or {x, y}."""
    return contains([_corners(polygon, ("x", "y"))], (x, y))


def inside_wgs84(latitude: float, longitude: float, polygon: object) -> bool:
    """The same in degrees, with corners [latitude, longitude]. A polygon may cross the antimeridian."""
    _check(latitude, longitude)
    corners = _corners(polygon, ("latitude", "longitude"))
    for corner in corners:
        _check(*corner)
    unrolled = [corners[0]]
    for here, there in corners[1:]:
        before = unrolled[-1][1]
        step = there - before
        unrolled.append((here, there - 360.0 * round(step / 360.0)))
    west, east = min(point[1] for point in unrolled), max(point[1] for point in unrolled)
    turns = range(math.ceil((west - longitude) / 360.0), math.floor((east - longitude) / 360.0) + 1)
    return any(contains([unrolled], (latitude, longitude + 360.0 * turn)) for turn in turns)


def count_inside(items: object, polygon: object, path: str = "") -> float:
    """The number of objects of a list that are inside the polygon."""
    corners = _corners(polygon, ("x", "y"))
    places = [place(item, f"items[{i}]", path) for i, item in enumerate(sequence(items, "items"))]
    return float(sum(contains([corners], (x, y)) for x, y, _ in places))


def _corners(polygon: object, names: tuple[str, str]) -> list[Point]:
    corners = [pair(corner, names, f"polygon[{i}]") for i, corner in enumerate(sequence(polygon, "polygon"))]
    if len(corners) < 3:
        raise ValueError(f"a polygon needs three corners or more; got {len(corners)}")
    if not all(map(math.isfinite, (number for corner in corners for number in corner))):
        raise ValueError("the corners of the polygon must be finite")
    return corners


def _check(latitude: float, longitude: float) -> None:
    if not -90 <= latitude <= 90:
        raise ValueError(f"latitude must be between -90 and 90 degrees; got {latitude:g}")
    if not -360 <= longitude <= 360:
        raise ValueError(f"longitude must be between -360 and 360 degrees; got {longitude:g}")


FUNCTIONS = (
    function(
        "wgs84Distance",
        ResultType.NUMBER,
        "the distance along the Earth's surface (ellipsoid WGS 84), metres",
        (wgs84_distance, "latitude1 longitude1 latitude2 longitude2"),
    ),
    function(
        "wgs84Bearing",
        ResultType.NUMBER,
        "the direction from the first position to the second, degrees in [0, 360) clockwise from north",
        (wgs84_bearing, "latitude1 longitude1 latitude2 longitude2"),
    ),
    function(
        "inside",
        ResultType.BOOLEAN,
        "whether the position is inside the polygon or on its edge; all numbers in the same unit",
        (inside, "x y polygon:list"),
    ),
    function(
        "insideWgs84",
        ResultType.BOOLEAN,
        "whether the position is inside the polygon or on its edge, in degrees; corners are [latitude, longitude]",
        (inside_wgs84, "latitude longitude polygon:list"),
    ),
    function(
        "countInside",
        ResultType.NUMBER,
        "the number of objects of a list that are inside the polygon or on its edge",
        (count_inside, "items:list polygon:list"),
        (count_inside, "items:list polygon:list path:string"),
    ),
)
