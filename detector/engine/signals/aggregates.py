"""Aggregates: reduce the values of a window to one value, or to unknown.

All take the known values in time order, the oldest first. Those that calculate take only numbers. Sums and differences
are exact and rounded once, so neither the order of a sum nor a counter of nanoseconds near 1e18 costs digits; beyond
the range of a double they are infinite, as in IEEE 754.

Rate and Delta are (last - first)/(time between) and last - first (see docs/rules.md). StdDev is the population's
(divided by n, so it is 0 for one value). Slope is the slope of the least-squares line, per second. Quantile
interpolates linearly between the two adjacent values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Final

from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN, Unknown, Value

Number = float | int
"""A double, or an integer beyond 2^53."""

Timed = tuple[int, Number]
"""A number and the time of its sample in nanoseconds."""

_SECOND = 10**9


def is_number(value: object) -> bool:
    """Whether aggregates calculate with the value; booleans are not numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def calculated(aggregate: Aggregate, window: Sequence[Timed], quantile: float | None = None) -> Number | Unknown:
    """An aggregate of numbers; unknown with too few samples, or if it is NaN. `quantile` is the parameter of
    Quantile."""
    if not window:
        return UNKNOWN
    result = _CALCULATED[aggregate](window) if quantile is None else _quantile(window, quantile)
    return UNKNOWN if result is UNKNOWN or result != result else result  # noqa: PLR0124 (NaN differs from itself)


def distinct(values: Sequence[Value]) -> list[Value] | Unknown:
    """The distinct values, in order of their first appearance; unknown if there are none.

    Values are equal if they have the same type and contents, lists and maps included: 1 is not true, and not "1".
    """
    found: dict[object, Value] = {}
    for value in values:
        found.setdefault(_identity(value), value)
    return list(found.values()) or UNKNOWN


def _minimum(window: Sequence[Timed]) -> Number:
    """A zero loses its sign: 0.0 and -0.0 are equal, so the result would depend on their order."""
    return min(number for _, number in window) or 0.0


def _maximum(window: Sequence[Timed]) -> Number:
    """A zero loses its sign, as in the minimum."""
    return max(number for _, number in window) or 0.0


def _minimum_time(window: Sequence[Timed]) -> Number:
    """Seconds since the epoch."""
    return min(window, key=lambda each: each[1])[0] / _SECOND


def _maximum_time(window: Sequence[Timed]) -> Number:
    """The first of the samples with the maximum."""
    return max(window, key=lambda each: each[1])[0] / _SECOND


def _sum(window: Sequence[Timed]) -> Number:
    """Infinite if one of the numbers is, NaN if there are infinities of both signs."""
    return _over([number for _, number in window], 1)


def _mean(window: Sequence[Timed]) -> Number:
    return _over([number for _, number in window], len(window))


def _over(numbers: Sequence[Number], divisor: int) -> float:
    """The sum of the numbers over the divisor, even if the sum itself overflows."""
    infinite = [number for number in numbers if math.isinf(number)]
    if infinite:
        return float(sum(infinite))
    if not any(isinstance(number, int) for number in numbers):
        try:
            return math.fsum(numbers) / divisor
        except OverflowError:
            pass
    return _double(sum(map(Fraction, numbers), Fraction()) / divisor)


def _deviation(window: Sequence[Timed]) -> Number:
    """Exact before the root."""
    if any(math.isinf(number) for _, number in window):
        return math.nan
    values, common = _whole(window)
    count = len(values)
    square = count * sum(value * value for value in values) - sum(values) ** 2
    bits = max(0, 64 - square.bit_length() // 2)  # so that the integer root has more digits than a double
    return _double(Fraction(math.isqrt(square << 2 * bits), common * count << bits))


def _slope(window: Sequence[Timed]) -> Number | Unknown:
    """Exact before rounding."""
    first, count = window[0][0], len(window)
    if first == window[-1][0]:
        return UNKNOWN
    if any(math.isinf(number) for _, number in window):
        return math.nan
    values, common = _whole(window)
    times = [time - first for time, _ in window]
    products = sum(time * value for time, value in zip(times, values, strict=True))
    squares = sum(time * time for time in times)
    total = sum(times)
    above = _SECOND * (count * products - total * sum(values))
    return _double(Fraction(above, common * (count * squares - total * total)))


def _whole(window: Sequence[Timed]) -> tuple[list[int], int]:
    """The numbers as integers over a common denominator; none is infinite."""
    ratios = [number.as_integer_ratio() for _, number in window]
    common = max(below for _, below in ratios)  # all are powers of two
    return [above * (common // below) for above, below in ratios], common


def _quantile(window: Sequence[Timed], quantile: float) -> Number:
    numbers = sorted(float(number) for _, number in window)
    place = quantile * (len(numbers) - 1)
    below = math.floor(place)
    part, low = place - below, numbers[below]
    if part == 0:
        return low + 0.0
    high = numbers[below + 1]
    return low + 0.0 if low == high else low * (1 - part) + high * part + 0.0


def _delta(window: Sequence[Timed]) -> Number | Unknown:
    return UNKNOWN if len(window) < 2 else _difference(window, Fraction(1))


def _rate(window: Sequence[Timed]) -> Number | Unknown:
    """Per second. Unknown if all samples have the same time, which is only possible for stamps."""
    if len(window) < 2 or window[-1][0] == window[0][0]:
        return UNKNOWN
    return _difference(window, Fraction(window[-1][0] - window[0][0], _SECOND))


def _difference(window: Sequence[Timed], divisor: Fraction) -> float:
    first, last = window[0][1], window[-1][1]
    if math.isinf(first) or math.isinf(last):
        return float(last) - float(first)
    return _double((Fraction(last) - Fraction(first)) / divisor)


def _double(exact: Fraction) -> float:
    """Rounded once; infinite beyond the range of a double."""
    try:
        return float(exact)
    except OverflowError:
        return math.inf if exact > 0 else -math.inf


def _identity(value: Value) -> object:
    """The identity of a value, as a dictionary key."""
    if isinstance(value, list):
        return (list, *map(_identity, value))
    if isinstance(value, dict):
        return (dict, *sorted(((str(key), _identity(part)) for key, part in value.items()), key=lambda each: each[0]))
    if isinstance(value, bool | str | bytes) or value is None:
        return (type(value), value)
    return (float, value)  # a double and an integer of equal value are the same number


_CALCULATED: Final[Mapping[Aggregate, Callable[[Sequence[Timed]], Number | Unknown]]] = {
    Aggregate.MIN: _minimum,
    Aggregate.MAX: _maximum,
    Aggregate.MEAN: _mean,
    Aggregate.SUM: _sum,
    Aggregate.RATE: _rate,
    Aggregate.DELTA: _delta,
    Aggregate.STD_DEV: _deviation,
    Aggregate.SLOPE: _slope,
    Aggregate.MIN_TIME: _minimum_time,
    Aggregate.MAX_TIME: _maximum_time,
}
