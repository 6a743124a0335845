"""Free data is bounded in size and depth."""

from __future__ import annotations

from typing import Any

import pytest

from wayside.api.freedata import MAXIMUM_BYTES, bounded, fitting, size

HALF = "x" * (MAXIMUM_BYTES // 2)


def test_a_map_may_take_at_most_64_kib() -> None:
    full = {"a": "x" * (MAXIMUM_BYTES - size({"a": ""}))}
    assert bounded(full) is full
    with pytest.raises(
        ValueError, match="65537 bytes as JSON exceeds the limit of 65536: shorten the largest value, a, "
    ):
        bounded({"a": f"{full['a']}x"})


@pytest.mark.parametrize("value", [[[[[[1]]]]], {"a": [{"b": [{"c": 1}]}]}, [[[[[[]]]]]], [[[[[{}]]]]]])
def test_five_levels_are_allowed(value: Any) -> None:
    assert bounded({"a": value}) == fitting({"a": value}) == {"a": value}


@pytest.mark.parametrize("value", [[[[[[[1]]]]]], {"a": [{"b": [{"c": [1]}]}]}])
def test_a_sixth_is_not(value: Any) -> None:
    with pytest.raises(ValueError, match="nested more than 5 levels deep: flatten it"):
        bounded({"a": value})
    assert fitting({"a": value, "b": 1}) == {"b": 1}


def test_the_largest_values_of_oversized_data_are_omitted() -> None:
    assert fitting({"a": 1, "b": HALF, "c": f"{HALF}x", "d": "text"}) == {"a": 1, "b": HALF, "d": "text"}
    assert fitting({"a": f"{HALF}{HALF}", "b": HALF}) == {"b": HALF}
