"""The algebra of the functions in expressions, and each against an obvious or independent computation."""

from __future__ import annotations

import math
import struct
import zlib

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wayside.expressions.functions.angles import angle_difference, heading_difference, pitch, roll, yaw
from wayside.expressions.functions.comparing import count_unmatched, nearest, unmatched
from wayside.expressions.functions.motion import closest_approach, closing, time_to_collision, time_to_contact
from wayside.expressions.functions.octets import all_zero, byte_count, checksum, number_at, utf8
from wayside.expressions.functions.places import count_inside, inside, inside_wgs84, wgs84_bearing, wgs84_distance

latitudes = st.floats(-89.9, 89.9)
longitudes = st.floats(-180, 180)
coordinates = st.floats(-1e4, 1e4)
grid = st.integers(-5, 5).map(float)
grid_points = st.tuples(grid, grid)
headings = st.floats(-1e4, 1e4)
places = st.lists(st.tuples(coordinates, coordinates), max_size=30)


@given(latitudes, longitudes, latitudes, longitudes)
def test_the_distance_on_wgs_84_is_karneys_and_a_metric(la1: float, lo1: float, la2: float, lo2: float) -> None:
    karney = Geodesic.WGS84.Inverse(la1, lo1, la2, lo2)
    assume(karney["a12"] < 178)  # almost opposite: see the next test
    distance = wgs84_distance(la1, lo1, la2, lo2)
    assert distance == pytest.approx(karney["s12"], abs=1e-3)
    assert distance == pytest.approx(wgs84_distance(la2, lo2, la1, lo1), abs=1e-3)
    assert distance == pytest.approx(wgs84_distance(la1, lo1 + 180, la2, lo2 + 180), abs=1e-3)
    assert wgs84_distance(la1, lo1, la1, lo1) == 0


@given(latitudes, longitudes, st.floats(-1, 1), st.floats(-1, 1))
def test_the_distance_between_antipodes_is_right_to_one_percent(
    latitude: float, longitude: float, north: float, east: float
) -> None:
    opposite = (max(-90.0, min(90.0, -latitude + north)), math.remainder(longitude + 180 + east, 360))
    karney = Geodesic.WGS84.Inverse(latitude, longitude, *opposite)["s12"]
    assert wgs84_distance(latitude, longitude, *opposite) == pytest.approx(karney, rel=0.01)


@given(st.floats(-85, 85), longitudes, st.floats(0, 360), st.floats(1, 50_000))
def test_the_bearing_is_the_direction_travelled(latitude: float, longitude: float, way: float, metres: float) -> None:
    there = Geodesic.WGS84.Direct(latitude, longitude, way, metres)
    assume(abs(there["lat2"]) < 89)
    bearing = wgs84_bearing(latitude, longitude, there["lat2"], there["lon2"])
    assert 0 <= bearing < 360
    assert abs(heading_difference(way, bearing)) < 0.3


@given(headings, headings, st.integers(-3, 3))
def test_a_turn_is_wrapped_and_leads_from_one_heading_to_the_other(start: float, end: float, rounds: int) -> None:
    turn = heading_difference(start, end)
    assert -180 < turn <= 180
    assert math.remainder(start + turn - end, 360) == pytest.approx(0, abs=1e-8)
    assert math.remainder(heading_difference(start + 360 * rounds, end) - turn, 360) == pytest.approx(0, abs=1e-8)
    assert abs(turn) == pytest.approx(abs(heading_difference(end, start)), abs=1e-8)
    assert math.remainder(angle_difference(math.radians(start), math.radians(end)) - math.radians(turn), math.tau) == (
        pytest.approx(0, abs=1e-10)
    )


def test_the_turn_across_north_is_the_shorter_one_and_half_a_turn_is_positive() -> None:
    assert heading_difference(350, 10) == 20
    assert heading_difference(10, 350) == -20
    assert heading_difference(0, 180) == heading_difference(180, 0) == 180


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.floats(0.1, 10))
def test_yaw_pitch_and_roll_are_the_rotations_that_made_the_quaternion(
    about_z: float, about_y: float, about_x: float, length: float
) -> None:
    x, y, z, w = (Rotation.from_euler("ZYX", [about_z, about_y, about_x]).as_quat() * length).tolist()
    quaternion = {"x": x, "y": y, "z": z, "w": w}
    assert yaw(quaternion) == pytest.approx(about_z, abs=1e-6)
    assert pitch(quaternion) == pytest.approx(about_y, abs=1e-6)
    assert roll(x, y, z, w) == pytest.approx(about_x, abs=1e-6)


@given(st.lists(grid_points, min_size=3, max_size=8), grid_points, st.integers(0, 7))
def test_inside_does_not_depend_on_the_first_corner_or_direction_of_the_polygon(
    polygon: list[tuple[float, float]], point: tuple[float, float], start: int
) -> None:
    found = inside(*point, polygon)
    turned = polygon[start % len(polygon) :] + polygon[: start % len(polygon)]
    assert inside(*point, turned) == inside(*point, polygon[::-1]) == inside(*point, [*polygon, polygon[0]]) == found
    mirrored = [[y, x] for x, y in polygon]
    assert inside(point[1], point[0], mirrored) == found
    assert count_inside([list(point), {"x": 1e3, "y": 0.0}], polygon) == found


@given(st.lists(st.tuples(coordinates, coordinates), min_size=3, max_size=8), st.data())
def test_corners_and_the_middles_of_edges_are_inside(polygon: list[tuple[float, float]], data: st.DataObject) -> None:
    index = data.draw(st.integers(0, len(polygon) - 1))
    assert inside(*polygon[index], polygon)
    dyadic = [(round(x * 8) / 8, round(y * 8) / 8) for x, y in polygon]  # so that the middle is a double itself
    (ax, ay), (bx, by) = dyadic[index], dyadic[index - 1]
    assert inside((ax + bx) / 2, (ay + by) / 2, dyadic)


@given(st.tuples(*[coordinates] * 6), st.tuples(coordinates, coordinates))
def test_inside_a_triangle_is_on_the_same_side_of_all_its_edges(
    numbers: tuple[float, ...], point: tuple[float, float]
) -> None:
    corners = np.array(numbers).reshape(3, 2)
    sides = [np.linalg.det([corners[i] - corners[i - 1], np.array(point) - corners[i - 1]]) for i in range(3)]
    assume(min(map(abs, sides)) > 1e-3)
    assert inside(*point, corners) == (min(sides) > 0 or max(sides) < 0)


@given(st.floats(-80, 80), longitudes, st.integers(-1, 1))
def test_inside_works_across_the_antimeridian(latitude: float, longitude: float, turns: int) -> None:
    def wrapped(degrees: float) -> float:
        return math.remainder(degrees, 360)

    box = [[latitude - 1, longitude - 2], [latitude - 1, longitude + 2], [latitude + 1, longitude + 2]]
    box.append([latitude + 1, longitude - 2])
    seamed = [[corner[0], wrapped(corner[1])] for corner in box]
    around = wrapped(longitude) + 180 * turns  # here, or on the other side of the globe
    assert inside_wgs84(latitude, around, seamed) == (turns == 0)
    assert inside_wgs84(latitude, wrapped(longitude + 1.9), seamed)
    assert not inside_wgs84(latitude, wrapped(longitude + 2.1), seamed)
    assert not inside_wgs84(latitude + 1.1, longitude, seamed)


@example(3.0, -4.0, 5e-324, 5e-324, 1.0)
@example(0.0, 3.0, 0.0, -1e-308, 1.0)
@given(*[st.floats(-100, 100)] * 4, st.floats(0, 10))
def test_at_the_time_to_collision_they_touch_and_never_before(
    dx: float, dy: float, vx: float, vy: float, radius: float
) -> None:
    def apart(t: float) -> float:
        return math.hypot(dx + vx * t, dy + vy * t)

    time = time_to_contact(dx, dy, vx, vy, radius)
    nearest_ever = closest_approach(dx, dy, vx, vy)
    if math.hypot(dx, dy) > 1:
        assert closing(dx, dy, vx, vy) == pytest.approx((apart(0) - apart(1e-7)) / 1e-7, abs=1e-3)
    assert time >= 0
    assert nearest_ever <= apart(0) * (1 + 1e-12)
    if math.isinf(time):
        assert nearest_ever >= radius * (1 - 1e-9) or math.hypot(vx, vy) < 1e-300  # then it is too long for a float
    elif time < 1e6:
        assert apart(time) <= radius * (1 + 1e-6) + 1e-6
        assert all(apart(time * part) >= radius - 1e-6 for part in (0.0, 0.3, 0.6, 0.9)) or time == 0
    sampled = min(apart(step / 10) for step in range(1000))
    assert nearest_ever <= sampled + 1e-9


def test_time_to_collision_of_a_gap() -> None:
    assert time_to_collision(20, 10) == 2
    assert time_to_collision(20, 0) == time_to_collision(20, -1) == math.inf
    assert time_to_collision(0, -1) == time_to_collision(-3, 5) == 0
    assert time_to_contact(20, 0, -10, 0, 0) == 2
    assert time_to_contact(22, 0, -10, 0, 2) == pytest.approx(2)


@given(places, places, st.floats(0, 2e4))
def test_unmatched_items_have_no_neighbour(
    items: list[tuple[float, float]], others: list[tuple[float, float]], within: float
) -> None:
    obvious = [i for i, here in enumerate(items) if not any(math.dist(here, there) <= within for there in others)]
    found = unmatched([{"x": x, "y": y} for x, y in items], [{"position": {"x": x, "y": y}} for x, y in others], within)
    assert found == obvious
    assert count_unmatched(items, others, within) == len(obvious)
    assert unmatched(items, items, within) == []
    assert unmatched(items, [], within) == list(range(len(items)))


@given(places, coordinates, coordinates)
def test_nearest_is_the_smallest_distance(items: list[tuple[float, float]], x: float, y: float) -> None:
    found = nearest([{"a": {"b": {"x": px, "y": py, "z": 99.0}}} for px, py in items], x, y, "a.b")
    assert found == pytest.approx(min((math.dist((x, y), item) for item in items), default=math.inf))


def test_objects_differ_in_height_too() -> None:
    bridge, road = {"pose": {"position": {"x": 1.0, "y": 1.0, "z": 6.0}}}, {"x": 1.0, "y": 1.0}
    assert count_unmatched([bridge], [road], 5.0) == 1
    assert count_unmatched([bridge], [road], 6.0) == 0
    assert count_unmatched([[1.0, 1.0, 6.0]], [bridge], 0.0) == 0


@given(st.binary(max_size=50) | st.integers(0, 10_000).map(bytes))
def test_bytes_functions_return_the_exact_bytes(data: bytes) -> None:
    assert all_zero(data) == all_zero(memoryview(data)) == (not any(data))
    assert checksum(data) == zlib.crc32(data)
    assert byte_count(data) == len(data)
    assert all_zero(data + b"\0") == all_zero(data)
    assert not all_zero(data + b"\1")


@given(st.integers(-(2**31), 2**31 - 1), st.floats(width=32, allow_nan=False), st.binary(max_size=9))
def test_numbers_are_read_where_they_were_packed(integer: int, double: float, before: bytes) -> None:
    data = before + struct.pack("<i", integer) + struct.pack(">f", double)
    assert number_at(data, len(before), "i32le") == integer
    assert number_at(data, len(before) + 4, "f32be") == double
    with pytest.raises(ValueError, match="no value"):
        number_at(data, len(before) + 5, "f32be")


@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")))
def test_a_text_round_trips_through_bytes(text: str) -> None:
    assert utf8(text.encode()) == text
