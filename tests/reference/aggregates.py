"""Aggregates of a window's values, as documented."""

from __future__ import annotations

import math
import statistics
from fractions import Fraction
from typing import Any

NOTHING = object()
"""Unknown."""


def aggregated(name: str, window: list[tuple[int, Any]], quantile: float | None = None) -> Any:
    """The aggregate of (time, value) pairs, the oldest first; an unknown value is NOTHING."""
    values = [value for _, value in window]
    if name == "Count":
        return float(len(values))
    if name in ("Last", "First", "Previous"):
        place = {"Last": -1, "First": 0, "Previous": -2}[name]
        return values[place] if len(values) >= (2 if name == "Previous" else 1) else NOTHING
    known = [(time, value) for time, value in window if value is not NOTHING]
    if name == "Distinct":
        different: list[Any] = []
        for _, value in known:
            if not any(_same(value, each) for each in different):
                different.append(value)
        return different or NOTHING
    if name in ("All", "Any"):
        truths = [value for _, value in known if isinstance(value, bool)]
        return any(truths) if name == "Any" else all(truths) if truths else NOTHING
    numbers = [(time, value) for time, value in known if isinstance(value, int | float) and not isinstance(value, bool)]
    if not numbers:
        return NOTHING
    result = (
        _quantile([number for _, number in numbers], quantile) if quantile is not None else _calculated(name, numbers)
    )
    return NOTHING if result is NOTHING or math.isnan(result) else result


def _calculated(name: str, numbers: list[tuple[int, Any]]) -> Any:
    plain = [number for _, number in numbers]
    infinite = any(math.isinf(number) for number in plain)
    if name in ("Min", "Max"):
        extreme = (min if name == "Min" else max)(plain)
        return 0.0 if extreme == 0 else extreme
    if name in ("Sum", "Mean"):
        if infinite:
            return sum(number for number in plain if math.isinf(number))
        return _double(sum(map(Fraction, plain), Fraction()) / (1 if name == "Sum" else len(plain)))
    if name == "StdDev":
        return math.nan if infinite else statistics.pstdev(plain)
    if name in ("MinTime", "MaxTime"):
        extreme = (min if name == "MinTime" else max)(plain)
        return next(time for time, number in numbers if number == extreme) / 10**9
    if name == "Slope":
        if numbers[0][0] == numbers[-1][0]:
            return NOTHING
        if infinite:
            return math.nan
        seconds = [Fraction(time - numbers[0][0], 10**9) for time, _ in numbers]
        values = [Fraction(number) for number in plain]
        middle, mean = sum(seconds) / len(seconds), sum(values) / len(values)
        both = sum(((s - middle) * (v - mean) for s, v in zip(seconds, values, strict=True)), Fraction())
        return _double(both / sum(((s - middle) ** 2 for s in seconds), Fraction()))
    (first_time, first), (last_time, last) = numbers[0], numbers[-1]
    if len(numbers) < 2 or (name == "Rate" and first_time == last_time):
        return NOTHING
    if math.isinf(first) or math.isinf(last):
        return float(last) - float(first)
    change = Fraction(last) - Fraction(first)
    return _double(change if name == "Delta" else change / Fraction(last_time - first_time, 10**9))


def _quantile(numbers: list[Any], quantile: float) -> Any:
    ordered = sorted(numbers)
    place = Fraction(quantile) * (len(ordered) - 1)
    low, high = ordered[math.floor(place)], ordered[math.ceil(place)]
    if math.isinf(low) or math.isinf(high):
        return float(low) + 0.0 if low == high or place.denominator == 1 else float(low) + float(high)
    return _double(Fraction(low) + (Fraction(high) - Fraction(low)) * (place - math.floor(place)))


def _double(exact: Fraction) -> float:
    try:
        return float(exact)
    except OverflowError:
        return math.copysign(math.inf, exact)


def _same(one: Any, other: Any) -> bool:
    return isinstance(one, bool) == isinstance(other, bool) and one == other
