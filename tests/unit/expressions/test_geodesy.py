"""Distances on the Earth agree with published ones, and with what any distance obeys."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wayside.geo.geodesy import SEMI_MAJOR, cartesian, surface_distance

QUARTER_MERIDIAN = 10_001_965.729
"""From the equator to a pole on WGS 84, in metres."""

latitudes = st.floats(-90, 90)
longitudes = st.floats(-180, 180)


@pytest.mark.parametrize(
    ("places", "metres"),
    [
        ((0, 0, 90, 0), QUARTER_MERIDIAN),
        ((0, 0, 0, 90), math.pi / 2 * SEMI_MAJOR),
        ((0, 0, 0, 1), math.radians(1) * SEMI_MAJOR),
        ((-90, 17, 90, -40), 2 * QUARTER_MERIDIAN),
        # From Flinders Peak to Buninyong, the worked example of the Geocentric Datum of Australia's manual (on GRS 80,
        # which differs from WGS 84 by less than a tenth of a millimetre here).
        ((-37.95103341666667, 144.42486788888888, -37.65282113888889, 143.92649552777777), 54_972.271),
    ],
)
def test_known_distances(places: tuple[float, float, float, float], metres: float) -> None:
    assert surface_distance(*places) == pytest.approx(metres, abs=2e-3)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((10, 179.9999, 10, -179.9999), (10, 0, 10, 0.0002)),  # the antimeridian
        ((10, 180, 10, -180), (10, 0, 10, 0)),
        ((10, 359.9999, 10, 0.0001), (10, 0, 10, 0.0002)),
        ((89.9999, 0, 89.9999, 180), (89.9998, 0, 90, 0)),  # over the pole
    ],
)
def test_distances_work_across_the_antimeridian(
    one: tuple[float, float, float, float], other: tuple[float, float, float, float]
) -> None:
    assert surface_distance(*one) == pytest.approx(surface_distance(*other), abs=1e-3)


@given(latitudes, longitudes, latitudes, longitudes)
def test_a_distance_is_symmetric_and_never_shorter_than_the_chord(a: float, b: float, c: float, d: float) -> None:
    length = surface_distance(a, b, c, d)
    assert length == pytest.approx(surface_distance(c, d, a, b), rel=1e-9, abs=1e-6)
    chord = math.dist(cartesian(a, b), cartesian(c, d))
    assert chord <= length * (1 + 1e-9) + 1e-6
    assert length <= 20_037_600  # half the globe
    if chord < 1_000:
        assert length == pytest.approx(chord, abs=1e-5)
    assert surface_distance(a, b, a, b) == 0
