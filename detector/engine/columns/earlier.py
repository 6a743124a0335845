"""The values of signals at earlier evaluations, for windows of signals over signals that start before a block.

Values are kept by subject for the length of the window. The number of evaluations in a block changes no result.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.table import Integers
from detector.engine.columns.windows import Ranges, aggregated_ranges, misfits
from detector.engine.counters import RuleCounters
from detector.engine.episodes.subjects import Subject
from wayside.expressions.columns.values import Bytes, Column, Doubles, Tag, Texts, value_at
from wayside.rules import CompiledDerived

_SHIFT = 32
_CLIENT = (1 << _SHIFT) - 1


class Evaluations(NamedTuple):
    """Evaluations of subjects; those of one subject are in time order."""

    keys: Integers
    """The subjects, see `EarlierValues.key`."""
    times: Integers
    last: int
    """The last tick of the block; nanoseconds, as all times."""


class _History(NamedTuple):
    """Values, by subject and then by time."""

    keys: Integers
    times: Integers
    values: Doubles
    tags: Bytes
    others: NDArray[Any] | None
    """Set if there are texts among them: their codes may not last."""


_EMPTY = _History(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.uint8), None)


class EarlierValues:
    """The earlier values of one rule's signals."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._next = 1
        self._history: dict[tuple[str, str | None], _History] = {}
        self.version = 0
        """Changes when numbers of clients are no longer valid."""

    def number(self, client: str) -> int:
        """The client's number; at least 1."""
        number = self._numbers.get(client)
        if number is None:
            number = self._numbers[client] = self._next
            self._next += 1
        return number

    def key(self, subject: Subject) -> int:
        """A subject without its element as an integer: a client's number, two of them for a pair, 0 for the fleet."""
        key = 0
        for client in subject.clients:
            key = key << _SHIFT | self.number(client)
        return key

    def pairs(self, first: Integers, second: Integers) -> Integers:
        """The keys of pairs of client numbers."""
        return first << _SHIFT | second

    def clear(self) -> None:
        """Forget all values: the windows were reset."""
        self._history.clear()
        self._numbers.clear()
        self.version += 1

    def forget_clients(self, clients: Collection[str]) -> None:
        """Forget lost clients: their earlier values do not count if they return."""
        gone = np.array([number for client in clients if (number := self._numbers.pop(client, None)) is not None])
        if not len(gone):
            return
        self.version += 1
        for place, kept in self._history.items():
            stay = ~(np.isin(kept.keys >> _SHIFT, gone) | np.isin(kept.keys & _CLIENT, gone))
            self._history[place] = _of(kept, stay)

    def window(
        self,
        signal: CompiledDerived,
        element: str | None,
        now: Evaluations,
        column: Column,
        texts: Texts,
        counters: RuleCounters,
    ) -> Column:
        """The signal at these evaluations; the column has the values that it aggregates. Counts values of the wrong
        kind."""
        if not signal.needs_history:
            return column
        rows = _joined(self._history.get((signal.name, element), _EMPTY), now, column, texts)
        low, high = _ranges(rows, now, signal)
        tags = None if (rows.tags == Tag.NUMBER).all() else rows.tags
        ranges = Ranges(rows.values, tags, rows.others, rows.times, low, high)
        wrong = misfits(signal.aggregate, ranges)
        if wrong is not None and (errors := int(wrong[0].sum())):
            counters.errors += errors
            worst = value_at(
                Column(ranges.values, ranges.tags, ranges.others), int(np.flatnonzero(wrong[1])[-1]), texts
            )
            counters.last_error = f"signal {signal.name}: {signal.aggregate} cannot use the value {worst!r:.80}"
        found = _with_texts(aggregated_ranges(signal.aggregate, ranges, texts, signal.quantile), texts)
        if found.tags is not None:
            counters.unknowns += int((found.tags == Tag.ABSENT).sum())
        reach = now.last - signal.lag_ns - signal.over_ns
        self._history[signal.name, element] = _of(rows, rows.times > reach)
        return found


def _of(kept: _History, rows: NDArray[np.bool_]) -> _History:
    if rows.all():
        return kept
    others = None if kept.others is None else kept.others[rows]
    return _History(kept.keys[rows], kept.times[rows], kept.values[rows], kept.tags[rows], others)


def _joined(kept: _History, now: Evaluations, column: Column, texts: Texts) -> _History:
    """The earlier values, merged with the new ones."""
    order = np.argsort(now.keys, kind="stable")
    keys = now.keys[order]
    tags = np.full(len(keys), Tag.NUMBER, np.uint8) if column.tags is None else column.tags[order]
    tags = np.where(tags == Tag.UNREACHABLE, np.uint8(Tag.ABSENT), tags)
    others = None if column.others is None else column.others[order]
    values = column.values[order]
    is_text = tags == Tag.TEXT
    if is_text.any():
        others = np.full(len(keys), None, object) if others is None else others
        for row in np.flatnonzero(is_text).tolist():
            others[row] = texts.text(int(values[row]))
        values, tags = np.where(is_text, 0.0, values), np.where(is_text, np.uint8(Tag.OTHER), tags)
    at = np.searchsorted(kept.keys, keys, side="right")
    if others is not None or kept.others is not None:
        before = np.full(len(kept.keys), None, object) if kept.others is None else kept.others
        others = np.insert(before, at, np.full(len(keys), None, object) if others is None else others)
    return _History(
        np.insert(kept.keys, at, keys),
        np.insert(kept.times, at, now.times[order]),
        np.insert(kept.values, at, values),
        np.insert(kept.tags, at, tags),
        others,
    )


def _ranges(rows: _History, now: Evaluations, signal: CompiledDerived) -> tuple[Integers, Integers]:
    """The window of each evaluation as a range of rows."""
    moments = np.unique(rows.times)
    changes = np.ones(len(rows.keys), bool)
    changes[1:] = rows.keys[1:] != rows.keys[:-1]
    width = len(moments) + 1
    places = (np.cumsum(changes) - 1) * width + np.searchsorted(moments, rows.times)
    own = np.searchsorted(rows.keys[changes], now.keys) * width
    end = now.times - signal.lag_ns
    low, high = (
        np.searchsorted(places, own + np.searchsorted(moments, each, "right")) for each in (end - signal.over_ns, end)
    )
    return low, high


def _with_texts(column: Column, texts: Texts) -> Column:
    """Replace texts in `others` by their codes."""
    if column.tags is None or column.others is None:
        return column
    for row in np.flatnonzero(column.tags == Tag.OTHER).tolist():
        if isinstance(text := column.others[row], str):
            column.values[row], column.tags[row] = texts.code(text), Tag.TEXT
    return column
