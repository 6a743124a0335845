"""Aggregates: each against an obvious computation, and the numbers at the edges of doubles."""

from __future__ import annotations

import itertools
import math
import statistics
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from detector.engine.signals.aggregates import calculated, distinct
from tests.driving import a_rule
from wayside.api.eventrule import OF_A_SAMPLE, WINDOWED, Aggregate
from wayside.expressions import UNKNOWN

SECOND = 10**9
COUNTER = 1_767_225_600_123_456_789
"""Nanoseconds since the epoch: far beyond 2^53."""

numbers = st.floats(allow_nan=False, allow_infinity=False) | st.integers(2**53 + 1, 2**64 - 1)


def timed(values: list[Any], every: int = SECOND) -> list[tuple[int, Any]]:
    return [(index * every, value) for index, value in enumerate(values)]


@given(st.lists(numbers, min_size=1))
def test_sums_and_means_are_exact_before_they_are_rounded_and_in_any_order(values: list[float]) -> None:
    exact = sum(map(Fraction, values), Fraction())
    for order in itertools.islice(itertools.permutations(values), 3):
        assert math.isclose(calculated(Aggregate.MEAN, timed(list(order))), float(exact / len(values)), rel_tol=1e-15)
        total = calculated(Aggregate.SUM, timed(list(order)))
        assert total == float(exact) if abs(exact) <= 1.797e308 else abs(Fraction(1e308)) < abs(exact)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1))
def test_the_standard_deviation_is_that_of_the_population(values: list[float]) -> None:
    found = calculated(Aggregate.STD_DEV, timed(values))
    assert isinstance(found, float)
    assert math.isclose(found, statistics.pstdev(map(Fraction, values)), rel_tol=1e-9, abs_tol=1e-9)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1), st.sampled_from([0.0, 0.1, 0.5, 0.95, 1.0]))
def test_a_quantile_is_interpolated_linearly(values: list[float], quantile: float) -> None:
    found = calculated(Aggregate.QUANTILE, timed(values), quantile)
    assert isinstance(found, float)
    assert math.isclose(found, np.quantile(values, quantile), rel_tol=1e-9, abs_tol=1e-9)


@given(st.lists(st.floats(-1e6, 1e6), min_size=2), st.integers(10**6, 10**10))
def test_a_slope_is_that_of_the_line_of_least_squares(values: list[float], every: int) -> None:
    found = calculated(Aggregate.SLOPE, timed(values, every))
    assert isinstance(found, float)
    exact = statistics.linear_regression([at * every / SECOND for at in range(len(values))], values).slope
    assert math.isclose(found, exact, rel_tol=1e-6, abs_tol=1e-6 * max(map(abs, values)) * SECOND / every + 1e-300)


@given(st.lists(st.floats(-1e6, 1e6), min_size=2), st.integers(1, 10**12))
def test_rate_times_the_time_between_is_delta(values: list[float], every: int) -> None:
    window = timed(values, every)
    delta, rate = calculated(Aggregate.DELTA, window), calculated(Aggregate.RATE, window)
    assert delta == values[-1] - values[0]
    assert isinstance(rate, float)
    assert math.isclose(rate * (window[-1][0] - window[0][0]) / SECOND, delta, rel_tol=1e-9, abs_tol=1e-300)


@pytest.mark.parametrize("aggregate", [Aggregate.DELTA, Aggregate.RATE, Aggregate.SLOPE])
def test_a_difference_needs_two_samples_and_a_rate_a_time_between_them(aggregate: Aggregate) -> None:
    assert calculated(aggregate, timed([5.0])) is UNKNOWN
    same_time = calculated(aggregate, [(0, 1.0), (0, 3.0)])
    assert same_time == 2.0 if aggregate is Aggregate.DELTA else same_time is UNKNOWN


def test_a_counter_beyond_2_53_has_an_exact_difference_rate_and_extremes() -> None:
    window = timed([COUNTER, COUNTER + 7], every=SECOND // 2)
    assert calculated(Aggregate.DELTA, window) == 7.0
    assert calculated(Aggregate.RATE, window) == 14.0
    assert calculated(Aggregate.MAX, window) == COUNTER + 7
    assert calculated(Aggregate.MIN, window) == COUNTER


@pytest.mark.parametrize(
    ("aggregate", "values", "wanted"),
    [
        (Aggregate.SUM, [1.7e308, 1.7e308], math.inf),
        (Aggregate.SUM, [1.7e308, 1.7e308, -1.7e308], 1.7e308),
        (Aggregate.SUM, [math.inf, -math.inf], UNKNOWN),
        (Aggregate.MEAN, [1.7e308, 1.7e308], 1.7e308),
        (Aggregate.MEAN, [-math.inf, 1.0], -math.inf),
        (Aggregate.MAX, [1.0, math.inf], math.inf),
        (Aggregate.DELTA, [1.0, math.inf], math.inf),
        (Aggregate.DELTA, [math.inf, math.inf], UNKNOWN),
        (Aggregate.DELTA, [-1.7e308, 1.7e308], math.inf),
        (Aggregate.RATE, [math.inf, 2.0], -math.inf),
        (Aggregate.STD_DEV, [1.0, math.inf], UNKNOWN),
        (Aggregate.STD_DEV, [1.7e308, -1.7e308], 1.7e308),
        (Aggregate.STD_DEV, [0.0, 0.0], 0.0),
        (Aggregate.STD_DEV, [3.0], 0.0),
    ],
)
def test_numbers_at_the_edge_of_doubles(aggregate: Aggregate, values: list[float], wanted: object) -> None:
    assert calculated(aggregate, timed(values)) == wanted


@pytest.mark.parametrize("aggregate", [Aggregate.MIN, Aggregate.SUM, Aggregate.MEAN, Aggregate.STD_DEV, Aggregate.RATE])
def test_an_empty_window_has_no_aggregate(aggregate: Aggregate) -> None:
    assert calculated(aggregate, []) is UNKNOWN


def test_distinct_keeps_the_first_of_each_value_and_types_apart() -> None:
    values = [2.0, "2", True, 1.0, 2.0, "", False, 0.0, [1.0, True], [1.0, True], [1.0, 1.0], {"a": 1.0}, {"a": True}]
    found = distinct(values)  # type: ignore[arg-type]
    assert repr(found) == repr([2.0, "2", True, 1.0, "", False, 0.0, [1.0, True], [1.0, 1.0], {"a": 1.0}, {"a": True}])
    assert distinct([]) is UNKNOWN


def test_only_single_sample_aggregates_and_age_need_no_window() -> None:
    for aggregate in set(Aggregate) - {Aggregate.ACTIVE}:
        signal = {"name": "s", "stream": "speed", "aggregate": aggregate.value}
        signal |= {"quantile": 0.5} if aggregate is Aggregate.QUANTILE else {}
        if aggregate not in (Aggregate.COUNT, Aggregate.AGE):
            with pytest.raises(ValidationError, match="needs a value"):
                a_rule(signals=[{**signal, "over": "5s"}], when="true")
            signal["value"] = "msg.v"
        if aggregate in WINDOWED:
            with pytest.raises(ValidationError, match="give over"):
                a_rule(signals=[signal], when="true")
        else:
            assert aggregate in OF_A_SAMPLE | {Aggregate.AGE}
            a_rule(signals=[signal], when="true")
        a_rule(signals=[{**signal, "over": "5s"}], when="true")


@pytest.mark.parametrize("aggregate", [Aggregate.MIN, Aggregate.MAX])
@pytest.mark.parametrize("values", [[-0.0], [0.0, -0.0], [-0.0, 0.0], [-0.0, 0.0, -0.0]])
def test_a_zero_of_min_and_max_is_unsigned_in_any_order_of_values(aggregate: Aggregate, values: list[float]) -> None:
    assert str(calculated(aggregate, timed(values))) == "0.0"
