"""The ages of the samples that rules use, for a whole block: see `detector.engine.counters.Ages`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from detector.engine.buffering.buffer import HOUSEKEEPING
from detector.engine.columns.table import Integers, Table, Truths
from detector.engine.counters import Ages, StreamUse

_POWERS = 10 ** np.arange(19, dtype=np.int64)


class Points(Protocol):
    """The points at which rules are evaluated."""

    @property
    def times(self) -> Integers:
        """The ticks of the points."""

    @property
    def numbers(self) -> Integers:
        """The numbers of their clients."""

    @property
    def clients(self) -> Sequence[str]:
        """The names of their clients."""


class SampleAges:
    """Notes the ages of the samples that a group of rules uses."""

    def __init__(self) -> None:
        self._newest: dict[str, dict[str, int]] = {}
        """By stream and client, the newest sample that was used; nanoseconds."""

    def used(
        self,
        rules: Sequence[Ages],
        stream: str,
        table: Table,
        duration: int,
        points: Points,
        high: Integers,
        latest: Integers,
        where: Truths,
    ) -> None:
        """Note that values were computed from the rows before `high` at these points; `rules` has each rule once per
        value.

        `latest` has the time of the newest sample at each point, which a cap may have evicted.
        """
        if not where.any():
            return
        ages = _counted((points.times - latest)[where])
        newest, periods = self._newest.setdefault(stream, {}), Counter[int]()
        first = np.array([newest.get(client, -1) for client in points.clients], np.int64)
        seen = np.where(where, latest, -1)
        before = np.maximum.accumulate(np.concatenate((first[:, None], seen[:, :-1]), axis=1), axis=1)
        new = where & (latest != before)
        if new.any():
            begin = points.times - points.times % HOUSEKEEPING - duration  # older samples have expired in the buffer
            several = (high - table.first[points.numbers][:, None] >= 2) & (
                table.times[np.maximum(high - 2, 0)] > begin
            )
            previous = np.where(several, table.times[np.maximum(high - 2, 0)], before)
            known = new & (previous >= 0) & (latest > previous)
            periods = _counted((latest - previous)[known])
            for at in np.flatnonzero(new.any(axis=1)).tolist():
                newest[points.clients[at]] = int(seen[at].max())
        counted: set[int] = set()
        for each in rules:
            use = each.uses.setdefault(stream, StreamUse())
            use.ages.update(ages)
            if id(each) not in counted:
                counted.add(id(each))
                use.periods.update(periods)


def _counted(times: NDArray[np.int64]) -> Counter[int]:
    """Nanoseconds, rounded to three digits, with their counts."""
    digits = np.searchsorted(_POWERS, times, side="right")
    unit = _POWERS[np.maximum(digits - 3, 0)]
    whole, rest = np.divmod(times, unit)
    up = (2 * rest > unit) | ((2 * rest == unit) & (whole % 2 == 1))
    values, counts = np.unique((whole + up) * unit, return_counts=True)
    return Counter(dict(zip(values.tolist(), counts.tolist(), strict=True)))
