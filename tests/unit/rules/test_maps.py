"""Places from GeoJSON and lanelet2 maps, in degrees and in metres, and errors in map files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import lanelet2
import lanelet2.core
import lanelet2.io
import lanelet2.projection
import numpy as np
import pytest

from detector.assembly import DetectorError, stream_readers
from tests.driving import a_detector, a_rule, a_stream
from wayside.geo.geometry import Shape
from wayside.geo.positions import positions_at
from wayside.rules import RuleError, compile_rule, own_problems

LATITUDE, LONGITUDE = 52.0, 10.0
ORIGIN = {"latitude": LATITUDE, "longitude": LONGITUDE}


def geojson(folder: Path, *features: dict[str, Any], **more: Any) -> str:
    path = folder / "zones.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **more}))
    return str(path)


def feature(name: str | None, kind: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    named = {} if name is None else {"name": name}
    return {
        "type": "Feature",
        "properties": {**named, **properties},
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def osm(folder: Path) -> str:
    """Two lanelets one after the other, a stop line and a polygon, 50 m east of the origin."""
    core = lanelet2.core
    written = core.LaneletMap()

    def line(*points: tuple[float, float], **tags: str) -> Any:
        found = core.LineString3d(core.getId(), [core.Point3d(core.getId(), x, y, 0) for x, y in points])
        for key, value in tags.items():
            found.attributes[key] = value
        return found

    lane = core.Lanelet(4711, line((50, 2), (100, 2)), line((50, -2), (100, -2)))
    lane.attributes["type"], lane.attributes["subtype"] = "lanelet", "road"
    written.add(lane)
    stop = line((90, -2), (90, 2), type="stop_line")
    stop.id = 77
    written.add(stop)
    path = folder / "town.osm"
    lanelet2.io.write(str(path), written, lanelet2.projection.UtmProjector(lanelet2.io.Origin(LATITUDE, LONGITUDE)))
    return str(path)


def shapes(*maps: dict[str, Any], **spec: Any) -> dict[str, Shape]:
    return dict(stream_readers(a_detector(a_stream("pose"), maps=[*maps], **spec)).places.shapes)


def at(value: float) -> Any:
    return np.array([value])


RING = [[10.0, 52.0], [10.01, 52.0], [10.01, 52.01], [10.0, 52.01], [10.0, 52.0]]
HOLE = [[10.004, 52.004], [10.006, 52.004], [10.006, 52.006], [10.004, 52.006], [10.004, 52.004]]


def test_geojson_is_on_the_earth_and_its_holes_are_outside(tmp_path: Path) -> None:
    path = geojson(
        tmp_path,
        feature("zone", "Polygon", [RING, HOLE]),
        feature("road", "LineString", RING[:2], width=6),
        feature(None, "LineString", RING[:2]),
        feature("pole", "Point", RING[0]),
    )
    found = shapes({"file": path})
    assert {name: shape.fields for name, shape in found.items()} == {
        "zone": ("inside", "distance"),
        "road": ("inside", "distance", "along", "across", "heading"),
    }
    zone = positions_at(found["zone"])
    assert [bool(zone.inside(at(each), at(each - 42))[0]) for each in (52.002, 52.005, 52.011)] == [True, False, False]
    assert positions_at(found["road"]).inside(at(52.00002), at(10.005))[0]


def test_with_an_origin_places_are_in_metres_of_the_projection(tmp_path: Path) -> None:
    for projection, name in (("Utm", "UtmProjector"), ("LocalCartesian", "LocalCartesianProjector")):
        projector = getattr(lanelet2.projection, name)(lanelet2.io.Origin(LATITUDE, LONGITUDE))
        corner = projector.forward(lanelet2.core.GPSPoint(52.01, 10.01, 0))
        path = geojson(tmp_path, feature("zone", "Polygon", [RING]))
        zone = shapes({"file": path, "origin": ORIGIN, "projection": projection})["zone"]
        assert not zone.geographic
        assert zone.rings[0][2] == (corner.x, corner.y)


def test_lanelets_are_lanes_and_stop_lines_are_lines(tmp_path: Path) -> None:
    path = osm(tmp_path)
    found = shapes({"file": path, "origin": ORIGIN})
    assert found.keys() == {"4711", "77"}
    lane, stop = found["4711"], found["77"]
    assert positions_at(lane).inside(at(60.0), at(1.0))[0]
    assert not positions_at(lane).inside(at(60.0), at(2.5))[0]
    assert positions_at(lane).arc(at(60.0), at(1.0)).along[0] == pytest.approx(10, abs=1e-3)
    assert positions_at(lane).arc(at(60.0), at(1.0)).across[0] == pytest.approx(1, abs=1e-3)
    assert positions_at(stop).arc(at(85.0), at(0.0)).across[0] == pytest.approx(5, abs=1e-3)
    on_earth = shapes({"file": path})["4711"]
    assert on_earth.geographic
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(LATITUDE, LONGITUDE))
    there = projector.reverse(lanelet2.core.BasicPoint3d(60, 1, 0))
    assert positions_at(on_earth).arc(at(there.lat), at(there.lon)).across[0] == pytest.approx(1, abs=0.01)


def test_rules_name_places_of_maps_and_the_manager_accepts_any(tmp_path: Path) -> None:
    stream = a_stream("pose", position={"x": "msg.x", "y": "msg.y"})
    detector = a_detector(stream, maps=[{"file": osm(tmp_path), "origin": ORIGIN}])
    rule = a_rule(signals=[{"name": "s", "stream": "pose", "value": 'at(position, "4711").inside'}], when="s")
    places = stream_readers(detector).places
    assert [shape.name for shape in compile_rule(rule, detector, places=places).places] == ["4711"]
    wrong = a_rule(signals=[{"name": "s", "stream": "pose", "value": 'at(position, "4712").inside'}], when="s")
    with pytest.raises(RuleError, match=r"there is no place 4712 \(did you mean 4711"):
        compile_rule(wrong, detector, places=places)
    assert compile_rule(wrong, detector).places == ()
    assert own_problems(wrong) == ()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("gone.geojson", None, "cannot read {}: No such file or directory; give the path as the detector sees it"),
        ("a.shp", "x", "{} is not a map: give a .geojson or .json file, or a lanelet2 map (.osm)"),
        ("a.json", "{", "{} is not JSON: "),
        ("a.json", "[]", "{} is not a FeatureCollection: it has no features"),
        ("a.osm", "<osm><node", "{} is not a lanelet2 map: "),
        ("a.osm", "<osm></osm>", "{} is not a lanelet2 map: it has no nodes"),
        (
            "a.json",
            json.dumps({"features": [], "crs": {"properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}}),
            "{} is in urn:ogc:def:crs:EPSG::25832: convert it to longitude and latitude, e.g. with ogr2ogr",
        ),
        ("a.json", json.dumps({"features": [feature("n", "Polygon", 3)]}), "{}, feature 0: cannot read the geometry"),
        (
            "a.json",
            json.dumps({"features": [feature("n", "Polygon", [[[0, 0], [2, 2], [2, 0], [0, 2], [0, 0]]])]}),
            "{}, place n: the edge from corner 0 to 1 crosses or touches the edge from 2 to 3",
        ),
        (
            "a.json",
            json.dumps({"features": [feature("n", "LineString", [[500000, 5760000], [500100, 5760000]])]}),
            "{}, place n: must be [latitude, longitude] in degrees; got [5.76e+06, 500000]",
        ),
        ("a.json", json.dumps({"features": [feature("own", "LineString", RING)]}), "another place has this name"),
    ],
)
def test_errors_of_a_map_are_located(tmp_path: Path, name: str, content: str | None, message: str) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    places = [{"name": "own", "line": [[0, 0], [1, 0]]}]
    with pytest.raises(DetectorError) as error:
        stream_readers(a_detector(a_stream("pose"), maps=[{"file": str(path)}], places=places))
    assert "spec.maps[0].file: " in str(error.value)
    assert message.format(path) in str(error.value)
