"""Durations are read as Go reads them, quantities as Kubernetes does."""

from __future__ import annotations

import pytest

from wayside.api.base import Duration, PositiveDuration, PositiveQuantity, Quantity

SECOND = 10**9


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("500ms", SECOND // 2),
        ("1h30m", 5400 * SECOND),
        ("1.5h", 5400 * SECOND),
        ("1m0.000000001s", 60 * SECOND + 1),
        ("1s1s", 2 * SECOND),
        ("3us7ns", 3007),
        ("0s", 0),
        ("0.9ns", 0),
    ],
)
def test_a_duration_is_a_sum_of_numbers_with_units(text: str, ns: int) -> None:
    assert Duration.parse(text).ns == ns
    assert str(Duration.parse(text)) == text


@pytest.mark.parametrize("text", ["", "1", "1 s", "-1s", "1d", "s", "1.s", ".5s", "1e3s", "1000000h", "1s1"])
def test_other_text_is_rejected_as_a_duration(text: str) -> None:
    with pytest.raises(ValueError, match="must be a duration with units, such as 500ms, 10s"):
        Duration.parse(text)


@pytest.mark.parametrize("text", ["0s", "0h0m", "0.0s", "0.5ns"])
def test_a_positive_duration_is_not_zero(text: str) -> None:
    with pytest.raises(ValueError, match="above zero"):
        PositiveDuration.parse(text)


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("512", 512),
        ("64Mi", 64 * 2**20),
        ("1.5Gi", 3 * 2**29),
        ("1e9", 10**9),
        ("12E6", 12 * 10**6),
        ("2E", 2 * 10**18),
        (".5k", 500),
        ("1.", 1),
        ("1500m", 2),
        ("1e-3", 1),
        ("0", 0),
    ],
)
def test_a_quantity_is_rounded_up_to_bytes(text: str, size: int) -> None:
    assert Quantity.parse(text).bytes == size


@pytest.mark.parametrize("text", ["", "much", "-1", "1 Gi", "1gi", "1e", "1i", ".", "e9"])
def test_other_text_is_rejected_as_a_quantity(text: str) -> None:
    with pytest.raises(ValueError, match="must be a quantity, such as 512Mi"):
        Quantity.parse(text)


@pytest.mark.parametrize("text", ["1", "010", "0.5", ".5Gi", "1.0", "0.000000001", "100000000000000000"])
def test_a_quantity_with_a_digit_above_zero_is_positive(text: str) -> None:
    assert PositiveQuantity.parse(text).value == Quantity.parse(text).value > 0


@pytest.mark.parametrize("text", ["0", "0.0Gi", "0e9", ".0", "00"])
def test_a_positive_quantity_is_not_zero(text: str) -> None:
    with pytest.raises(ValueError, match="above zero"):
        PositiveQuantity.parse(text)
