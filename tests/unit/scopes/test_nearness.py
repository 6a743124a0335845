"""Which pairs are within reach: the same by comparing all and by trees, nearest first where there are too many."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import permutations
from random import Random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.scoping.nearness import Near, Search, near_pairs
from detector.engine.scoping.positions import Point, distance, point
from wayside.rules import CompiledPosition

FLAT = CompiledPosition("pose", {})
EARTH = CompiledPosition("pose", {"latitude": None, "longitude": None})  # type: ignore[dict-item]

coordinates = st.floats(-1e4, 1e4) | st.integers(-300, 300).map(float) | st.sampled_from([1e12, -1e12])
points = st.tuples(coordinates, coordinates, st.sampled_from([0.0, 1.0]))
degrees = st.tuples(
    st.floats(-90, 90) | st.sampled_from([90.0, -90.0, 89.9999, 0.0, 48.0]),
    st.floats(-180, 180) | st.sampled_from([180.0, -180.0, 179.9999, -179.9999, 360.0, 0.0]),
)
roles = st.none() | st.tuples(st.integers(0, 7), st.integers(0, 7))


def search(position: CompiledPosition, places: Mapping[str, Point], role: tuple[int, int] | None = None) -> Search:
    """`role`: of the clients, who can be a and who b, as a mask over the numbers in their names."""
    first, second = (
        (None, None)
        if role is None
        else tuple([name for name in places if mask >> int(name[3:]) % 3 & 1] for mask in role)
    )
    return Search(
        {name: point(position, place) for name, place in places.items()},
        lambda a, b: distance(position, places[a], places[b]),
        first,
        second,
    )


def obvious(requested: Search, within: float, maximum: int) -> Near:
    first = requested.points.keys() if requested.first is None else requested.first
    second = requested.points.keys() if requested.second is None else requested.second
    near = sorted(
        (requested.distance(a, b), a, b)
        for a, b in permutations(requested.points, 2)
        if a in first and b in second and (requested.first is not None or a < b) and requested.distance(a, b) <= within
    )
    return Near([(a, b) for _, a, b in near[:maximum]], max(0, len(near) - maximum))


@settings(max_examples=80)
@given(st.lists(points, max_size=70), st.sampled_from([0.5, 100.0, 250.0, 1e6]), roles)
def test_the_pairs_within_reach_match_a_comparison_of_all(
    placed: list[Point], within: float, role: tuple[int, int] | None
) -> None:
    requested = search(FLAT, {f"car{index}": place for index, place in enumerate(placed)}, role)
    found, expected = near_pairs(requested, within, 10_000), obvious(requested, within, 10_000)
    assert sorted(found.pairs) == sorted(expected.pairs)
    assert found.left_out == 0


@settings(max_examples=80)
@given(st.lists(degrees, max_size=50), st.sampled_from([1.0, 30.0, 5_000.0, 1e6]), roles)
def test_on_the_earth_pairs_are_found_across_poles_and_the_antimeridian(
    placed: list[Point], within: float, role: tuple[int, int] | None
) -> None:
    requested = search(EARTH, {f"car{index}": place for index, place in enumerate(placed)}, role)
    assert sorted(near_pairs(requested, within, 10_000).pairs) == sorted(obvious(requested, within, 10_000).pairs)


# Of very many pairs, those whose distances differ by less than a nanometre count as equally far.
MICROMETRES = st.floats(0, 100).map(lambda metres: round(metres, 6))


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 3).map(float) | MICROMETRES, st.just(0.0), st.just(0.0)), max_size=60),
    st.integers(1, 300),
    roles,
)
def test_beyond_the_maximum_the_nearest_pairs_are_evaluated_then_by_name(
    placed: list[Point], maximum: int, role: tuple[int, int] | None
) -> None:
    requested = search(FLAT, {f"car{index:02}": place for index, place in enumerate(placed)}, role)
    found, expected = near_pairs(requested, 50.0, maximum), obvious(requested, 50.0, maximum)
    assert sorted(found.pairs) == sorted(expected.pairs)
    assert found.left_out == expected.left_out


def test_thousands_of_clients_at_one_position_do_not_make_millions_of_pairs() -> None:
    places = {f"car{index:04}": (5.0, 5.0, 0.0) for index in range(3_000)}
    measured = 0

    def counted(a: str, b: str) -> float:
        nonlocal measured
        measured += 1
        return math.dist(places[a], places[b])

    found = near_pairs(Search(places, counted, None, None), 50.0, 1_000)
    assert len(found.pairs) == 1_000
    assert found.left_out == 3_000 * 2_999 // 2 - 1_000
    assert found.pairs[0] == ("car0000", "car0001")
    assert measured < 10_000


@settings(max_examples=50)
@given(st.randoms(use_true_random=False), st.floats(1e-7, 1e-4), st.floats(-80, 80), st.floats(-180, 180))
def test_a_pair_whose_distance_is_exactly_within_is_found_on_the_earth_however_many_there_are(
    random: Random, spread: float, latitude: float, longitude: float
) -> None:
    places = {
        f"car{index}": (latitude + spread * random.random(), longitude + spread * random.random())
        for index in range(40)
    }
    requested = search(EARTH, places)  # type: ignore[arg-type]
    within = requested.distance("car3", "car7")
    assert sorted(near_pairs(requested, within, 10_000).pairs) == sorted(obvious(requested, within, 10_000).pairs)


@given(degrees, degrees)
def test_the_distance_on_the_earth_is_the_same_number_in_both_directions(
    one: tuple[float, float], other: tuple[float, float]
) -> None:
    assert distance(EARTH, one, other) == distance(EARTH, other, one)


@given(points, points)
def test_the_distance_in_a_flat_frame_equals_that_of_columns(one: Point, other: Point) -> None:
    apart = np.array([one]) - np.array([other])
    squares = apart * apart
    assert distance(FLAT, one, other) == np.sqrt((squares[:, 0] + squares[:, 1]) + squares[:, 2])[0]
    assert distance(FLAT, one, other) == distance(FLAT, other, one)
