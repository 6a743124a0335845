"""Aggregates over ranges of rows: the values of a signal at many points at once.

The results equal those of `detector.engine.signals.aggregates` to the last digit. Aggregates that cannot be computed
for all ranges at once are computed by those functions, once for each range that differs from the previous one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.table import Integers
from detector.engine.signals.aggregates import Timed, calculated, distinct, is_number
from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN, Unknown
from wayside.expressions.columns.values import Column, Tag, Texts, value_at

Numbers = NDArray[np.float64]
Tags = NDArray[np.uint8]

EXTREMES: Final = frozenset({Aggregate.MIN, Aggregate.MAX})

_ONE_BY_ONE: Final = frozenset(
    {
        Aggregate.RATE, Aggregate.STD_DEV, Aggregate.QUANTILE, Aggregate.SLOPE, Aggregate.MIN_TIME, Aggregate.MAX_TIME,
    }
)  # fmt: skip
"""Aggregates of numbers that are computed for each range separately."""

_HUGE = 1e290
"""Sums of numbers up to this value do not overflow."""

_GRIDS = 4


class Ranges:
    """Rows of a table, and the ranges of them that form the windows. Shapes: rows (N,), ranges any."""

    __slots__ = ("begin", "high", "low", "others", "tags", "times", "values")

    def __init__(
        self, values: Numbers, tags: Tags | None, others: NDArray[Any] | None, times: Integers, low: Integers,
        high: Integers,
    ) -> None:  # fmt: skip
        """`tags` None: all rows are numbers. Only the rows that occur in some range are kept."""
        begin = int(low.min(initial=len(values)))
        end = max(int(high.max(initial=0)), begin)
        self.values, self.times = values[begin:end], times[begin:end]
        self.tags = None if tags is None else tags[begin:end]
        self.others = None if others is None else others[begin:end]
        self.low, self.high = low - begin, high - begin
        self.begin = begin
        """The table's index of the first of these rows."""

    def picked(self, keep: NDArray[np.bool_]) -> None:
        """Keep only these rows, and adjust the ranges."""
        before = np.concatenate(([0], np.cumsum(keep)))
        self.low, self.high = before[self.low], before[self.high]
        self.values, self.times = self.values[keep], self.times[keep]
        self.tags = None if self.tags is None else self.tags[keep]
        self.others = None if self.others is None else self.others[keep]


def extremes(aggregate: Aggregate, values: Numbers, lows: Sequence[Integers], high: Integers) -> list[Column]:
    """The aggregate Min or Max of windows of several lengths that end at the same rows, from the shortest.

    All rows are numbers. Each row is read once, not once per length. Shapes: values (N,), lows and high any.
    """
    begin = int(lows[-1].min(initial=len(values)))
    end = max(int(high.max(initial=0)), begin)
    longer = values[begin : end + 1] if end < len(values) else np.append(values[begin:end], 0.0)
    count = len(lows)
    borders = np.empty((high.size, count + 1), np.int64)  # of each point, the first row of the longest window first
    for at, low in enumerate(lows, start=1):
        borders[:, count - at] = low.ravel()
    borders[:, count] = high.ravel()
    borders -= begin
    least = np.minimum if aggregate is Aggregate.MIN else np.maximum
    parts = least.reduceat(longer, borders.ravel()).reshape(borders.shape)[:, :-1]
    # For an empty part, reduceat returns the row at which it would begin.
    nothing = np.inf if aggregate is Aggregate.MIN else -np.inf
    parts = np.where(borders[:, 1:] > borders[:, :-1], parts, nothing)
    found = least.accumulate(parts[:, ::-1], axis=1) + 0.0  # the sign of zero does not matter: no -0.0
    some = (borders[:, :-1] < borders[:, -1:])[:, ::-1] & ~np.isnan(found)
    if some.all():
        return [Column(found[:, at], None, None) for at in range(count)]
    found = np.where(some, found, 0.0)
    tags = some.astype(np.uint8) * np.uint8(Tag.NUMBER)
    return [Column(found[:, at], tags[:, at], None) for at in range(count)]


def aggregated_ranges(aggregate: Aggregate, rows: Ranges, texts: Texts, quantile: float | None = None) -> Column:
    """The aggregate of each range, flat. Values that the aggregate cannot use are left out: see `misfits`.

    `quantile` is the parameter of the aggregate Quantile.
    """
    low, high = rows.low.ravel(), rows.high.ravel()
    count = high - low
    match aggregate:
        case Aggregate.COUNT:
            return Column(count.astype(float), None, None)
        case Aggregate.LAST | Aggregate.FIRST | Aggregate.PREVIOUS:
            return _one(aggregate, rows, low, high)
    tags = rows.tags
    wanted = _wanted(aggregate)
    if aggregate is Aggregate.DISTINCT or (
        wanted is Tag.NUMBER and tags is not None and rows.others is not None and _has_integers(rows)
    ):
        return _each(aggregate, rows, texts, quantile)
    if tags is None and wanted is Tag.BOOLEAN:
        tags = np.full(len(rows.values), Tag.NUMBER, np.uint8)
    if tags is not None and (odd := tags != wanted).any():
        rows.tags = tags
        rows.picked(~odd)
        low, high = rows.low.ravel(), rows.high.ravel()
        count = high - low
    if wanted is Tag.BOOLEAN:
        return _truth(aggregate, rows.values, low, high)
    if aggregate in _ONE_BY_ONE:
        return _each(aggregate, rows, texts, quantile)
    some = count > (1 if aggregate is Aggregate.DELTA else 0)
    if aggregate in EXTREMES:
        return extremes(aggregate, rows.values, [rows.low], rows.high)[0]
    values = np.append(rows.values, 0.0)
    if aggregate is Aggregate.DELTA:
        with np.errstate(all="ignore"):
            found = values[np.maximum(high - 1, 0)] - values[low] + 0.0
    else:
        sums = _sums(values, low, high)
        if sums is None:
            return _each(aggregate, rows, texts)
        with np.errstate(all="ignore"):
            found = sums / count if aggregate is Aggregate.MEAN else sums
    some &= ~np.isnan(found)
    if some.all():
        return Column(found, None, None)
    return Column(np.where(some, found, 0.0), np.where(some, Tag.NUMBER, Tag.ABSENT).astype(np.uint8), None)


def misfits(aggregate: Aggregate, rows: Ranges) -> tuple[Integers, NDArray[np.bool_]] | None:
    """The number of values in each range (flat) that the aggregate cannot use, and which rows these are; None: none."""
    if aggregate not in NUMERIC and aggregate not in (Aggregate.ANY, Aggregate.ALL):
        return None
    if rows.tags is None:
        if aggregate in NUMERIC:
            return None
        odd = np.ones(len(rows.values), bool)
    else:
        odd = (rows.tags != _wanted(aggregate)) & (rows.tags != Tag.ABSENT)
        if aggregate in NUMERIC and rows.others is not None:
            odd &= ~np.fromiter((isinstance(each, int) for each in rows.others), bool, len(rows.others))
    if not odd.any():
        return None
    before = np.concatenate(([0], np.cumsum(odd)))
    return (before[rows.high] - before[rows.low]).ravel(), odd


def _wanted(aggregate: Aggregate) -> Tag:
    return Tag.BOOLEAN if aggregate in (Aggregate.ANY, Aggregate.ALL) else Tag.NUMBER


def _one(aggregate: Aggregate, rows: Ranges, low: Integers, high: Integers) -> Column:
    """The value of one row of each range."""
    if aggregate is Aggregate.FIRST:
        at, some = low, high > low
    else:
        back = 1 if aggregate is Aggregate.LAST else 2
        at, some = high - back, high - low >= back
    if not len(rows.values):
        return Column(np.zeros(len(low)), np.zeros(len(low), np.uint8), None)
    at = np.where(some, at, 0)
    values, others = rows.values[at], None
    if some.all() and rows.tags is None:
        return Column(values, None, None)
    tags = np.where(some, Tag.NUMBER if rows.tags is None else rows.tags[at], Tag.ABSENT).astype(np.uint8)
    if rows.others is not None and (tags == Tag.OTHER).any():
        others = rows.others[at]
    return Column(np.where(some, values, 0.0), tags, others)


def _truth(aggregate: Aggregate, values: Numbers, low: Integers, high: Integers) -> Column:
    true = np.concatenate(([0], np.cumsum(values != 0)))
    holds = true[high] - true[low]
    if aggregate is Aggregate.ANY:
        return Column((holds > 0).astype(float), np.full(len(low), Tag.BOOLEAN, np.uint8), None)
    tags = np.where(high > low, Tag.BOOLEAN, Tag.ABSENT).astype(np.uint8)
    return Column(((holds == high - low) & (high > low)).astype(float), tags, None)


def _each(aggregate: Aggregate, rows: Ranges, texts: Texts, quantile: float | None = None) -> Column:
    """Compute each range by the function for one window, once for each range that differs from the previous one."""
    found: list[Any] = []
    before: tuple[int, int] | None = None
    result: Any = UNKNOWN
    times, column = rows.times.tolist(), Column(rows.values, rows.tags, rows.others)
    for low, high in zip(rows.low.ravel().tolist(), rows.high.ravel().tolist(), strict=True):
        if (low, high) != before:
            before = (low, high)
            window = [(times[row], value_at(column, row, texts)) for row in range(low, high)]
            if aggregate is Aggregate.DISTINCT:
                result = distinct([value for _, value in window if not isinstance(value, Unknown)])
            else:
                numbers = [(time, value) for time, value in window if is_number(value)]
                result = calculated(aggregate, cast("list[Timed]", numbers), quantile)
        found.append(result)
    return _column(found)


def _column(found: Sequence[Any]) -> Column:
    """A column of numbers, lists and unknowns."""
    values, tags = np.zeros(len(found)), np.zeros(len(found), np.uint8)
    others: NDArray[Any] | None = None
    for at, each in enumerate(found):
        if isinstance(each, float):
            values[at], tags[at] = each, Tag.NUMBER
        elif each is not UNKNOWN:
            others = np.empty(len(found), object) if others is None else others
            others[at], tags[at] = each, Tag.OTHER
    return Column(values, tags, others)


def _has_integers(rows: Ranges) -> bool:
    """Whether some numbers are integers rather than doubles."""
    assert rows.others is not None  # noqa: S101  the caller looked
    return any(isinstance(each, int) for each in rows.others[rows.tags == Tag.OTHER])


def _pairs(low: Integers, high: Integers) -> Integers:
    """Interleave the bounds as `reduceat` needs them: every second of its results is a window's."""
    pairs = np.empty(2 * len(low), np.int64)
    pairs[0::2], pairs[1::2] = low, high
    return pairs


def _sums(values: Numbers, low: Integers, high: Integers) -> Numbers | None:
    """The sum of each range, computed exactly and rounded once; None if one may overflow or is not finite.

    The numbers are split on grids so coarse that sums of the parts are exact. `values` has one additional element at
    its end.
    """
    most = int(np.max(high - low, initial=1))
    top = float(np.max(np.abs(values), initial=0.0))
    if not top * most < _HUGE:
        return None
    pairs = _pairs(low, high)
    bits = 52 - max(1, most).bit_length()
    exponent = math.frexp(top)[1]
    parts: list[Numbers] = []
    rest = values
    for _ in range(_GRIDS):
        big = 1.5 * 2.0**52 * math.ldexp(1.0, max(exponent - bits, -1070))
        part = (rest + big) - big
        sums = np.add.reduceat(part, pairs)[::2]
        sums[high <= low] = 0.0
        parts.append(sums)
        rest = rest - part
        exponent -= bits
        if not rest.any():
            break
    else:
        plain = values.tolist()
        return np.array(
            [math.fsum(plain[begin:end]) for begin, end in zip(low.tolist(), high.tolist(), strict=True)], float
        )
    if len(parts) == 1:
        return parts[0]
    if len(parts) == 2:
        total: Numbers = parts[0] + parts[1]  # both are exact: rounded once
        return total
    return np.array([math.fsum(each) for each in zip(*(part.tolist() for part in parts), strict=True)])


NUMERIC: Final = frozenset(
    {
        Aggregate.MIN, Aggregate.MAX, Aggregate.MEAN, Aggregate.SUM, Aggregate.RATE, Aggregate.DELTA, Aggregate.STD_DEV,
        Aggregate.QUANTILE, Aggregate.SLOPE, Aggregate.MIN_TIME, Aggregate.MAX_TIME,
    }
)  # fmt: skip
"""The aggregates that take only numbers."""
