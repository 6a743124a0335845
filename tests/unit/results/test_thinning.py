"""Long series made short: extremes of each part and exact points stay."""

from __future__ import annotations

import numpy as np
import pytest

from detector.results.series import Series, thinned

NOTHING = np.zeros(0, np.int64)


def waving(count: int, seed: int = 1) -> Series:
    chance = np.random.default_rng(seed)
    values = np.cumsum(chance.normal(size=count))
    values[chance.integers(0, count, 20)] = np.nan
    return Series(np.arange(count, dtype=np.int64) * 100, values)


@pytest.mark.parametrize("buckets", [1, 7, 100])
def test_each_part_keeps_its_minimum_and_maximum(buckets: int) -> None:
    series = waving(20_000)
    end = int(series.times[-1])
    short = thinned(series, 0, end, buckets, NOTHING)
    assert len(short.times) <= 2 * buckets + 2 + 4 * 20
    for part in range(buckets):
        low, high = end * part // buckets, end * (part + 1) // buckets
        inside = (series.times >= low) & (series.times < high)
        kept = (short.times >= low) & (short.times < high)
        assert np.nanmin(series.values[inside]) == pytest.approx(np.nanmin(short.values[kept]))
        assert np.nanmax(series.values[inside]) == pytest.approx(np.nanmax(short.values[kept]))


def test_values_at_and_before_exact_times_are_kept() -> None:
    series = waving(20_000)
    exact = np.array([12_345, 500_000, 1_777_777], np.int64)
    short = thinned(series, 0, int(series.times[-1]), 5, exact)
    assert np.array_equal(short.at(exact), series.at(exact), equal_nan=True)
    assert np.array_equal(short.at(exact - 100), series.at(exact - 100), equal_nan=True)


def test_transitions_between_known_and_unknown_are_kept() -> None:
    series = waving(20_000)
    short = thinned(series, 0, int(series.times[-1]), 5, NOTHING)
    unknown = series.times[np.isnan(series.values)]
    assert np.isnan(short.at(unknown)).all()


def test_a_short_series_is_unchanged() -> None:
    series = waving(100)
    assert thinned(series, 0, 10_000, 50, NOTHING) is series
