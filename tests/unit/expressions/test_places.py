"""Places and the frames of road users: against shapely, and in columns the very numbers of single positions."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import shapely
import yaml
from geographiclib.geodesic import Geodesic
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.driving import a_detector, a_rule, a_stream
from tests.guides import guide, yaml_blocks
from wayside.expressions import UNKNOWN, CelType, Environment
from wayside.expressions.columns import Graph, Program, Tag, Texts
from wayside.expressions.expanding import FIELDS_AT, FIELDS_SEEN, NamedPlaces
from wayside.geo.geometry import Shape, interned
from wayside.rules import RuleError, compile_rule, own_problems, place_problems

STAR = ((0.0, 0.0), (8.0, 1.0), (5.0, 4.0), (9.0, 9.0), (4.0, 6.0), (0.0, 9.0), (2.0, 4.0))
BEND = ((0.0, 0.0), (6.0, 0.0), (6.0, 5.0), (1.0, 7.0))
SHAPES = {
    each.name: interned(each)
    for each in (
        Shape("star", False, rings=(STAR,)),
        Shape("line", False, line=BEND),
        Shape("lane", False, line=BEND, width=3.0),
        Shape("both", False, rings=(STAR,), line=BEND),
        Shape("town", True, rings=(((52.0, 10.0), (52.0, 10.01), (52.01, 10.01), (52.01, 10.0)),)),
        Shape("dateline", True, line=((-17.0, 179.999), (-17.0, -179.999))),
    )
}
coordinates = st.one_of(st.sampled_from([0.0, 6.0, 5.0, 4.0, 9.0, -0.0]), st.floats(-20, 20, width=32))
ROAD_USER = {"x": 1.0, "y": 2.0, "yaw": 0.5}


@cache
def compiled(source: str, **places: Any) -> Any:
    environment = Environment({"p": CelType.DYN, "a": CelType.MAP, "b": CelType.MAP})
    return environment.naming(NamedPlaces(SHAPES, **places)).compile(source)


def at(name: str, field: str, x: float, y: float, **more: float) -> Any:
    axes = ("latitude", "longitude") if SHAPES[name].geographic else ("x", "y")
    position = {axes[0]: x, axes[1]: y, **more}
    return compiled(f'at(p, "{name}").{field}').evaluate_or_unknown({"p": position})


@given(coordinates, coordinates)
def test_areas_and_lines_are_as_in_shapely(x: float, y: float) -> None:
    area, line, point = shapely.Polygon(STAR), shapely.LineString(BEND), shapely.Point(x, y)
    if area.boundary.distance(point) > 1e-9:
        assert at("star", "inside", x, y) is bool(area.covers(point))
    assert at("star", "distance", x, y) == pytest.approx(area.distance(point), abs=1e-9)
    assert at("line", "distance", x, y) == pytest.approx(line.distance(point), abs=1e-9)
    along, across = at("line", "along", x, y), at("line", "across", x, y)
    assert min(max(along, 0.0), line.length) == pytest.approx(line.project(point), abs=1e-6) or (
        abs(line.distance(point) - line.interpolate(min(max(along, 0.0), line.length)).distance(point)) < 1e-9
    )
    if 0 <= along <= line.length:
        assert abs(across) == pytest.approx(line.distance(point), abs=1e-9)
        assert at("lane", "inside", x, y) is (abs(across) <= 1.5)
    if abs(across) > 1e-6 and line.distance(point) < 0.9 and 0 < along < line.length:
        left = line.buffer(1, single_sided=True, join_style="mitre", cap_style="flat")
        assert (across > 0) is bool(left.covers(point))


def test_edges_and_corners_belong_to_an_area() -> None:
    assert all(at("star", "inside", *corner) is True for corner in STAR)
    assert at("star", "inside", 4.0, 0.5) is True
    assert at("star", "inside", 4.0, math.nextafter(0.5, 0)) is False


def test_before_and_beyond_the_ends_the_line_continues_straight() -> None:
    assert (at("line", "along", -2.0, 1.0), at("line", "across", -2.0, 1.0)) == (-2.0, 1.0)
    length = 6 + 5 + math.hypot(5, 2)
    assert at("line", "along", 1.0 - 5, 7.0 + 2) == pytest.approx(length + math.hypot(5, 2))
    assert at("lane", "inside", -0.1, 0.0) is False
    assert at("lane", "distance", -3.0, -5.5) == pytest.approx(math.hypot(3, 4))


def test_headings_are_against_the_line_and_positive_to_the_left() -> None:
    assert at("lane", "heading", 3.0, 0.0, yaw=math.radians(30)) == pytest.approx(30)
    assert at("lane", "heading", 6.0, 3.0, yaw=math.radians(-90)) == 180.0
    assert at("dateline", "heading", -17.0, 180.0, heading=80.0) == pytest.approx(10)
    assert at("lane", "heading", 3.0, 0.0) is UNKNOWN


def test_on_the_earth_distances_are_those_of_the_ellipsoid() -> None:
    north = Geodesic.WGS84.Inverse(52.01, 10.005, 52.015, 10.005)["s12"]
    east = Geodesic.WGS84.Inverse(52.0, 10.01, 52.0, 10.02)["s12"]
    assert at("town", "distance", 52.015, 10.005) == pytest.approx(north, rel=1e-3)
    assert at("town", "distance", 52.0, 10.02) == pytest.approx(east, rel=1e-3)
    assert at("town", "inside", 52.005, -349.995) is True
    assert at("dateline", "along", -17.0, -180.0) == pytest.approx(106.4, rel=1e-2)
    assert at("town", "inside", 91.0, 10.0) is UNKNOWN


@settings(max_examples=30)
@given(st.lists(st.tuples(coordinates | st.just(math.inf), coordinates, coordinates), min_size=1, max_size=40))
def test_columns_give_the_same_numbers_as_single_positions(rows: list[tuple[float, float, float]]) -> None:
    axes = ("x", "y", "yaw")
    for source in (f'at(p, "{name}").{field}' for name in ("star", "lane", "both") for field in SHAPES[name].fields):
        graph, texts = Graph(), Texts()
        expression = compiled(source)
        node = graph.add(expression, lambda path: path[-1])
        assert node is not None
        program = Program(graph, [node], texts)
        values = np.array([[row[axes.index(str(leaf))] for row in rows] for leaf in program.leaves])
        results = program.run(values, None)
        expected = [expression.evaluate_or_unknown({"p": dict(zip(axes, row, strict=True))}) for row in rows]
        if source.endswith("inside"):
            true, false = results.truths([graph.truth(node)])
            found: list[Any] = [True if t else False if f else UNKNOWN for t, f in zip(true[0], false[0], strict=True)]
        else:
            column = results.column(node)
            tags = np.full(len(rows), Tag.NUMBER) if column.tags is None else column.tags
            found = [v if t == Tag.NUMBER else UNKNOWN for v, t in zip(column.values.tolist(), tags, strict=True)]
        assert repr(found) == repr(expected)


@given(
    *[st.floats(-50, 50) for _ in range(4)], *[st.floats(-7, 7) for _ in range(2)], st.floats(0, 30), st.floats(0, 30)
)
def test_another_road_user_is_located_in_the_own_frame(
    x: float, y: float, u: float, v: float, yaw: float, other: float, speed: float, faster: float
) -> None:
    a = {"position": {"x": x, "y": y}, "yaw": yaw, "speed": speed}
    b = {"position": {"x": u, "y": v}, "yaw": other, "speed": faster}
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    place = turn @ (u - x, v - y)
    velocity = turn @ (faster * np.array([math.cos(other), math.sin(other)])) - (speed, 0)
    wanted = dict(zip(("ahead", "left", "speedAhead", "speedLeft"), (*place, *velocity), strict=True))
    found = {
        field: compiled(f"seenFrom(a, b).{field}", geographic=False).evaluate({"a": a, "b": b}) for field in FIELDS_SEEN
    }
    heading = found.pop("heading")
    assert found == pytest.approx(wanted, abs=1e-9)
    assert -180 < heading <= 180
    assert math.cos(math.radians(heading)) == pytest.approx(math.cos(other - yaw), abs=1e-9)


def test_another_road_user_is_located_on_the_earth() -> None:
    a = {"position": {"latitude": 52.0, "longitude": 10.0}, "heading": 90.0, "speed": 10.0}
    b = {"position": {"latitude": 52.001, "longitude": 10.002}, "heading": 0.0, "speed": 5.0}
    found = [compiled(f"seenFrom(a, b).{f}", geographic=True).evaluate({"a": a, "b": b}) for f in FIELDS_SEEN]
    assert found == pytest.approx([137.3, 111.3, -10.0, 5.0, 90.0], rel=1e-3)


DETECTOR = a_detector(
    a_stream("pose", position={"x": "msg.x", "y": "msg.y"}),
    a_stream("gnss", position={"latitude": "msg.lat", "longitude": "msg.lon"}),
    a_stream("speed"),
    a_stream("late", position={"x": "msg.x + sample.latency * msg.v", "y": "msg.y"}),
    places=[
        {"name": "crossing", "area": [[0, 0], [4, 0], [4, 4]]},
        {"name": "stop", "line": [[0, 0], [4, 0]]},
        {"name": "town", "frame": "Wgs84", "area": [[52, 10], [52, 11], [53, 11]]},
    ],
)


@pytest.mark.parametrize(
    ("stream", "value", "message"),
    [
        ("pose", 'at(position, "crosing").inside', "line 1, column 14: there is no place crosing (did"),
        ("pose", 'at(position, "stop").inside', "stop is a line without width, which has no inside"),
        ("pose", 'at(position, "crossing").along', "crossing is an area, which has no along (it has inside, distance)"),
        ("pose", 'at(position, "crossing")', "`at` needs a field (write "),
        ("pose", 'at(position, "stop").left', "column 22: at has no field left"),
        ("pose", 'at(position, "stop").heading', "the position of stream pose has no yaw; place stop is in metres"),
        ("gnss", 'at(position, "stop").across', "has no x; place stop is in metres (it has latitude, longitude)"),
        ("pose", 'at(position, "town").inside', "has no latitude; place town is in degrees"),
        ("speed", 'at(position, "stop").across', "stream speed has no position (set position in this stream of the"),
        ("gnss", "positionBefore.altitude", "the position of stream gnss has no altitude (it has latitude, longitude)"),
        ("late", "positionBefore.x", "positionBefore of stream late is unknown, because its position reads sample"),
        ("pose", "1 + at(position, msg.name).inside", "column 18: the name of a place must be a string in quotes"),
        ("pose", "seenFrom(msg, msg).ahead", "`seenFrom` needs two clients (use it in a rule with scope pairs)"),
        ("pose", 'at(position, "crossing").inside + 1', "does not take (bool, double)"),
    ],
)  # fmt: skip
def test_invalid_uses_of_a_place_are_located(stream: str, value: str, message: str) -> None:
    rule = a_rule(signals=[{"name": "s", "stream": stream, "value": value}], when="true")
    with pytest.raises(RuleError, match="signals") as error:
        compile_rule(rule, DETECTOR)
    assert message in str(error.value)


def test_the_position_before_is_that_of_the_message_or_item_before() -> None:
    of_items = {"items": "msg.objects", "client": "${item.id}", "key": "station/objects"}
    detector = a_detector(
        a_stream("pose", position={"x": "msg.pos.msg", "y": "msg . y"}),
        a_stream("list", position={"x": "item.x", "y": "item.y"}, **of_items),
    )
    for stream, paths in (
        ("pose", {("before", "pos", "msg"), ("before", "y")}),
        ("list", {("before", "x"), ("before", "y")}),
    ):
        value = "positionBefore.x + positionBefore.y"
        rule = compile_rule(a_rule(signals=[{"name": "s", "stream": stream, "value": value}], when="s > 0"), detector)
        assert rule.signals[0].value is not None
        assert rule.signals[0].value.paths == paths


def test_pairs_need_a_position_and_get_that_of_their_stream() -> None:
    rule = a_rule(scope={"pairs": {"position": {"stream": "speed"}, "within": 5}}, when="distance < 3")
    with pytest.raises(RuleError, match=r"scope.pairs.position.stream: stream speed has no position: give x and y"):
        compile_rule(rule, DETECTOR)
    rule = a_rule(scope={"pairs": {"position": {"stream": "gnss"}, "within": 5}}, when="a.position.latitude < 3")
    assert compile_rule(rule, DETECTOR).subject.position.geographic  # type: ignore[union-attr]


def test_a_pair_has_no_direction_to_compare_with_a_line() -> None:
    pairs = {"pairs": {"position": {"stream": "pose"}, "within": 5}}
    with pytest.raises(RuleError, match=r"column 5: the position of a pair has no direction \(use a signal over the"):
        compile_rule(a_rule(scope=pairs, when='1 < at(a.position, "stop").heading'), DETECTOR)


def test_problems_of_a_rule_are_not_attributed_to_places() -> None:
    for when in ('at(a.position, "anywhere").inside', "seenFrom(a, b).ahead > 3"):
        assert own_problems(a_rule(scope={"pairs": {"position": {"stream": "x"}, "within": 5}}, when=when)) == ()


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ({"area": [[0, 0], [4, 4], [4, 0], [0, 4]]}, "places[0].area: the edge from corner 0 to 1 crosses or touches"),
        ({"area": [[0, 0], [4, 0], [4, 0], [0, 4]]}, "places[0].area: the edge from corner"),
        ({"line": [[1, 2], [1, 2]]}, "places[0].line: all points of the line are the same: give two or more different"),
        (
            {"frame": "Wgs84", "line": [[10, 52], [100, 52]]},
            "places[0].line[1]: must be [latitude, longitude] in degrees; got [100, 52]",
        ),
        (
            {"line": [[0, 0], [1e13, 0]]},
            "places[0].line[1]: must be at most 1e+12 metres from the origin; got [1e+13, 0]",
        ),
    ],
)
def test_invalid_places_are_located(place: dict[str, Any], message: str) -> None:
    detector = a_detector(a_stream("pose"), places=[{"name": "p", **place}])
    (problem,) = place_problems(detector)
    assert message in str(problem)


def test_a_changed_place_of_the_same_name_changes_the_rule() -> None:
    rule = a_rule(signals=[{"name": "s", "stream": "pose", "value": 'at(position, "stop").across'}], when="s > 0")
    pose = a_stream("pose", position={"x": "msg.x", "y": "msg.y"})
    digests = [
        compile_rule(rule, a_detector(pose, places=[{"name": "stop", "line": line}])).digest
        for line in ([[0, 0], [4, 0]], [[0, 0], [4, 0]], [[0, 0], [4, 1]])
    ]
    assert digests[0] == digests[1] != digests[2]


def test_every_field_is_a_field_of_some_place() -> None:
    assert {field for shape in SHAPES.values() for field in shape.fields} == FIELDS_AT.keys()


def test_the_guides_examples_and_tables_match_the_code() -> None:
    text = guide("places")
    detector, rule, maps, pair = (yaml.safe_load(block) for block in yaml_blocks(text))
    known = a_detector(*detector["spec"]["streams"], places=detector["spec"]["places"])
    a_detector(a_stream("pose"), **maps["spec"])
    for each in (rule, pair):
        compile_rule(a_rule(**each["spec"]), known)
