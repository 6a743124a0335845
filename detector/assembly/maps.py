"""Places from map files: GeoJSON, and lanelet2 maps (OSM files).

On the Earth a map's coordinates are latitude and longitude. With an `origin` they are projected to metres by lanelet2's
projections. Lanelets become lanes; ways of type stop_line and ways with a name become lines; lanelet2's polygons become
areas. Objects without a name get their id as name.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

from wayside.api import Detector
from wayside.api.place import MapFile, Projection
from wayside.geo.geometry import Point, Shape, interned
from wayside.rules import KnownPlaces, RuleProblem, places_of, shape_problems

_CRS84: Final = ("urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:OGC::CRS84", "urn:ogc:def:crs:EPSG::4326")


class MapError(ValueError):
    """A map file that cannot be used; the message contains the reason and the remedy."""


def known_places(detector: Detector) -> tuple[KnownPlaces, tuple[RuleProblem, ...]]:
    """The places of the Detector and of its maps, and the problems of the maps. Reads the files."""
    shapes = dict(places_of(detector))
    problems: list[RuleProblem] = []
    for index, each in enumerate(detector.spec.maps):
        try:
            found = list(_shapes(each))
        except MapError as error:
            problems.append(RuleProblem(("spec", "maps", index, "file"), str(error)))
            continue
        for shape in found:
            for text in _problems(shape, shapes):
                problems.append(
                    RuleProblem(("spec", "maps", index, "file"), f"{each.file}, place {shape.name}: {text}")
                )
            shapes.setdefault(shape.name, interned(shape))
    return KnownPlaces(shapes, complete=not problems), tuple(problems)


def _problems(shape: Shape, others: Mapping[str, Shape]) -> Iterator[str]:
    if shape.name in others:
        yield "another place has this name: rename one of them"
    for ring in shape.rings or ((),):
        yield from (text for _, text in shape_problems(shape.geographic, ring or None, shape.line or None))


def _shapes(given: MapFile) -> Iterator[Shape]:
    path = Path(given.file)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MapError(f"cannot read {given.file}: {error.strerror}; give the path as the detector sees it") from None
    if path.suffix == ".osm":
        yield from _of_lanelet2(given, content)
    elif path.suffix in (".geojson", ".json"):
        yield from _of_geojson(given, content)
    else:
        raise MapError(f"{given.file} is not a map: give a .geojson or .json file, or a lanelet2 map (.osm)")


# GeoJSON


def _of_geojson(given: MapFile, content: bytes) -> Iterator[Shape]:
    try:
        document = json.loads(content)
    except ValueError as error:
        raise MapError(f"{given.file} is not JSON: {error}") from None
    features = document.get("features") if isinstance(document, Mapping) else None
    if not isinstance(features, list):
        raise MapError(f"{given.file} is not a FeatureCollection: it has no features")
    crs = ((document.get("crs") or {}).get("properties") or {}).get("name", _CRS84[0])
    if crs not in _CRS84:
        raise MapError(
            f"{given.file} is in {crs}: convert it to longitude and latitude, e.g. with ogr2ogr -t_srs OGC:CRS84"
        )
    frame = _Frame(given)
    for index, feature in enumerate(features):
        try:
            shape = _of_feature(feature, frame)
        except (TypeError, ValueError, KeyError, AttributeError, IndexError) as error:
            raise MapError(f"{given.file}, feature {index}: cannot read the geometry: {error}") from None
        if shape is not None:
            yield shape


def _of_feature(feature: Mapping[str, Any], frame: _Frame) -> Shape | None:
    """The place of a feature; None if it has no name or is of another kind."""
    properties, geometry = feature.get("properties") or {}, feature.get("geometry") or {}
    name = properties.get("name", feature.get("id"))
    if name is None:
        return None
    rings: list[tuple[Point, ...]] = []
    line: tuple[Point, ...] = ()
    match geometry.get("type"):
        case "Polygon":
            rings = [frame.points(ring[:-1]) for ring in geometry["coordinates"]]
        case "MultiPolygon":
            rings = [frame.points(ring[:-1]) for polygon in geometry["coordinates"] for ring in polygon]
        case "LineString":
            line = frame.points(geometry["coordinates"])
        case _:
            return None
    width = float(properties["width"]) if line and "width" in properties else None
    return Shape(str(name), frame.geographic, tuple(rings), line, width)


class _Frame:
    """Converts longitude and latitude into the coordinates of places."""

    def __init__(self, given: MapFile) -> None:
        self.geographic = given.origin is None
        self._projector = (
            None if given.origin is None else _projector(given, given.origin.latitude, given.origin.longitude)
        )

    def points(self, coordinates: Sequence[Sequence[float]]) -> tuple[Point, ...]:
        return tuple(self._point(float(each[0]), float(each[1])) for each in coordinates)

    def _point(self, longitude: float, latitude: float) -> Point:
        if self._projector is None:
            return latitude, longitude
        point = self._projector.forward(_lanelet2().core.GPSPoint(latitude, longitude, 0.0))
        return float(point.x), float(point.y)


# lanelet2


def _of_lanelet2(given: MapFile, content: bytes) -> Iterator[Shape]:
    lanelet2 = _lanelet2()
    if given.origin is not None:
        projector = _projector(given, given.origin.latitude, given.origin.longitude)
    else:
        projector = _projector(given, *_first_node(given, content))
    try:
        loaded, errors = lanelet2.io.loadRobust(given.file, projector)
    except RuntimeError as error:
        raise MapError(f"{given.file} is not a lanelet2 map: {error}") from None
    if len(errors):
        raise MapError(
            f"{given.file} is not a valid lanelet2 map: {errors[0].strip()}; and {len(errors) - 1} more errors"
        )

    def points(line: Any) -> tuple[Point, ...]:
        if given.origin is not None:
            return tuple((float(each.x), float(each.y)) for each in line)
        reverse = (projector.reverse(lanelet2.core.BasicPoint3d(each.x, each.y, 0.0)) for each in line)
        return tuple((float(each.lat), float(each.lon)) for each in reverse)

    geographic = given.origin is None
    for each in loaded.laneletLayer:
        yield Shape(_name(each), geographic, (points(each.polygon2d()),), points(each.centerline))
    for each in loaded.polygonLayer:
        yield Shape(_name(each), geographic, (points(each),))
    for each in loaded.lineStringLayer:
        if "name" in each.attributes or ("type" in each.attributes and each.attributes["type"] == "stop_line"):
            yield Shape(_name(each), geographic, line=points(each))


def _name(primitive: Any) -> str:
    tags = primitive.attributes  # no dict: it has no get
    return str(tags["name"]) if "name" in tags else str(primitive.id)


def _first_node(given: MapFile, content: bytes) -> tuple[float, float]:
    try:
        node = ElementTree.fromstring(content).find("node")  # noqa: S314  the operator's own file
    except ElementTree.ParseError as error:
        raise MapError(f"{given.file} is not a lanelet2 map: {error}") from None
    if node is None:
        raise MapError(f"{given.file} is not a lanelet2 map: it has no nodes")
    return float(node.get("lat", "nan")), float(node.get("lon", "nan"))


def _projector(given: MapFile, latitude: float, longitude: float) -> Any:
    lanelet2 = _lanelet2()
    projections = {
        Projection.UTM: lanelet2.projection.UtmProjector,
        Projection.LOCAL_CARTESIAN: lanelet2.projection.LocalCartesianProjector,
    }
    return projections[given.projection](lanelet2.io.Origin(latitude, longitude))


def _lanelet2() -> Any:
    try:
        import lanelet2  # noqa: PLC0415  an extra
        import lanelet2.core  # noqa: PLC0415
        import lanelet2.io  # noqa: PLC0415
        import lanelet2.projection  # noqa: PLC0415
    except ImportError:
        raise MapError("lanelet2 is not installed: pip install 'wayside[maps]'") from None
    return lanelet2
