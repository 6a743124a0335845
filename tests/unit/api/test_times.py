"""Times keep their nanoseconds in text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wayside.times import format_time, parse_time

YEAR_1 = -62_135_596_800 * 10**9
YEAR_10000 = 253_402_300_800 * 10**9


@given(st.integers(YEAR_1, YEAR_10000 - 1))
def test_every_nanosecond_survives(ns: int) -> None:
    assert parse_time(format_time(ns)) == ns


@given(st.integers(0, YEAR_10000 - 1), st.integers(0, YEAR_10000 - 1))
def test_text_sorts_as_time_does(one: int, other: int) -> None:
    assert (format_time(one) < format_time(other)) == (one < other)


def test_always_nine_digits_in_utc() -> None:
    assert format_time(1_767_225_600_000_000_000) == "2026-01-01T00:00:00.000000000Z"
    assert format_time(1_767_225_600_123_456_789) == "2026-01-01T00:00:00.123456789Z"


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("1970-01-01T00:00:00Z", 0),
        ("1970-01-01T00:00:00.5Z", 500_000_000),
        ("1970-01-01T02:00:00+02:00", 0),
        ("1969-12-31T23:59:59.999999999Z", -1),
    ],
)
def test_times_of_other_programs_are_read(text: str, ns: int) -> None:
    assert parse_time(text) == ns


@pytest.mark.parametrize("text", ["", "yesterday", "2026-01-01", "2026-13-01T00:00:00Z", "2026-01-01T00:00:00", "1"])
def test_invalid_times_are_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r"must be a time"):
        parse_time(text)


def test_a_year_beyond_9999_is_rejected() -> None:
    with pytest.raises(ValueError, match="years 1 to 9999"):
        format_time(YEAR_10000)
