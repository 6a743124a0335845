"""Places: named areas, lines and lanes that rules refer to."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from wayside.api.access import FilePath
from wayside.api.base import ATOMIC_LIST, ClientName, Model
from wayside.api.constraints import constraint

Corner = Annotated[list[float], Field(min_length=2, max_length=2, json_schema_extra=ATOMIC_LIST)]
"""x and y, or latitude and longitude."""


class CoordinateFrame(StrEnum):
    """The meaning of the coordinates of a place."""

    METRES = "Metres"
    WGS84 = "Wgs84"


class Place(Model):
    """A named area, line or lane."""

    constraints = (
        constraint(
            "has(self.area) || has(self.line)",
            "give area, line, or both",
            holds=lambda place: place.area is not None or place.line is not None,
        ),
        constraint(
            "!has(self.width) || (has(self.line) && !has(self.area))",
            "width is valid only for a line without area: remove width or area",
            holds=lambda place: place.width is None or (place.line is not None and place.area is None),
        ),
    )

    name: ClientName
    """The name of the place in expressions, as in at(position, "crossing")."""
    frame: CoordinateFrame = CoordinateFrame.METRES
    """Metres: the points are x and y in the frame of the positions. Wgs84: they are latitude and longitude in
    degrees."""
    area: list[Corner] | None = Field(default=None, min_length=3, max_length=1000, json_schema_extra=ATOMIC_LIST)
    """The corners of an area. It is closed automatically, and its edges must not cross."""
    line: list[Corner] | None = Field(default=None, min_length=2, max_length=1000, json_schema_extra=ATOMIC_LIST)
    """The points of a line, in its direction. With an area, the place is a lane: the line is its centreline, and the
    area its surface."""
    width: float | None = Field(default=None, gt=0, le=1000)
    """The width of a lane in metres. The line is its centreline."""


class Origin(Model):
    """The point on the Earth at which x and y of a map are 0."""

    latitude: float = Field(ge=-90, le=90)
    """Degrees north (WGS 84)."""
    longitude: float = Field(ge=-180, le=180)
    """Degrees east (WGS 84)."""


class Projection(StrEnum):
    """The projection of a map from degrees to metres."""

    UTM = "Utm"
    LOCAL_CARTESIAN = "LocalCartesian"


class MapFile(Model):
    """A file with places."""

    file: FilePath
    """The path of a GeoJSON file (.geojson, .json) or a lanelet2 map (.osm), as the detector sees it: relative to its
    working directory, or on a mounted volume. The name of a place is its property or tag `name`; without one, its
    id."""
    origin: Origin | None = None
    """The point at which x and y are 0. With it, places are in metres, by projection. Default: places are in degrees
    (WGS 84)."""
    projection: Projection = Projection.UTM
    """Only with origin. Utm: metres of the UTM zone of the origin. LocalCartesian: metres east and north on the plane
    that touches the Earth at the origin."""
