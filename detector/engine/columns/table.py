"""The samples of one stream as a table: a segment of rows for each client, in order of time.

All segments lie in one flat array. The key of a row is its client and its time in one integer, and the keys ascend over
the whole array: so a single binary search finds the windows of all clients at all ticks. A segment has room for more
rows behind it; when it is full, the table is repacked with the rows that are still needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.engine.buffering.buffer import NEVER
from detector.engine.samples.sample import Sample

Integers = NDArray[np.int64]
Truths = NDArray[np.bool_]

MAXIMUM_CLIENTS = 2**17 - 1
"""Numbers of clients are below this: 17 bits of a key."""

LONGEST = 2**44
"""Maximum length of a window in nanoseconds (almost five hours): a table reaches back twice as far."""

_SHIFT = 46
_REACH = 2**46
"""Range of times that keys can represent, in nanoseconds."""
_LEAST_ROOM = 16
_BATCHES = 3
"""Maximum number of further batches of the same size that have room after repacking: moving rows costs more than adding
them."""


class StoredColumn:
    """The values of one expression, by row: a `Column` (see wayside.expressions.columns) that grows with its table."""

    __slots__ = ("odd", "others", "tags", "values")

    def __init__(self, rows: int) -> None:
        self.values = np.zeros(rows)
        self.tags = np.zeros(rows, np.uint8)
        self.others: NDArray[Any] | None = None
        self.odd = False
        """Whether any row has ever been other than a number."""


class Table:
    """The rows of one stream. Clients are numbers."""

    def __init__(self) -> None:
        self.keys: Integers = np.zeros(0, np.int64)
        self.times: Integers = np.zeros(0, np.int64)
        self.samples: NDArray[Any] = np.empty(0, object)
        self.filled: Truths = np.zeros(0, bool)
        """Which rows have their columns filled."""
        self.columns: list[StoredColumn] = []
        self.marks: list[Integers] = []
        """Marks: indices in the segments, by client, that move with the rows."""
        self.start: Integers = np.zeros(0, np.int64)
        self.room: Integers = np.zeros(0, np.int64)
        self.first: Integers = np.zeros(0, np.int64)
        """The first row of each client."""
        self.end: Integers = np.zeros(0, np.int64)
        """The index after the last row of each client."""
        self.dropped: Integers = np.zeros(0, np.int64)
        """The greatest time of all rows that were dropped, of each client, or NEVER."""
        self._base: int | None = None

    @property
    def clients(self) -> int:
        """Number of clients that the table has room for."""
        return len(self.end)

    def grow(self, clients: int) -> None:
        """Make room for at least this number of clients; for twice as many as before, since clients come one by one."""
        if clients > len(self.end):
            more = max(clients, 2 * len(self.end)) - len(self.end)
            size = len(self.keys)
            self.start, self.first, self.end = (
                np.append(each, np.full(more, size)) for each in (self.start, self.first, self.end)
            )
            self.room = np.append(self.room, np.zeros(more, np.int64))
            self.dropped = np.append(self.dropped, np.full(more, NEVER))
            self.marks[:] = [np.append(mark, np.full(more, size)) for mark in self.marks]

    def mark(self) -> int:
        """Add a mark at the first row of each client. Returns its index in `marks`."""
        self.marks.append(self.first.copy())
        return len(self.marks) - 1

    def append(self, clients: NDArray[np.integer[Any]], times: Integers, samples: Sequence[Sample]) -> None:
        """Add rows, in the order of their arrival; a late one is inserted by its time."""
        if not len(samples):
            return
        order = np.argsort(clients, kind="stable")
        whose, ordered = clients[order], times[order]
        counts = np.bincount(whose, minlength=len(self.end))
        if self._base is None:
            self._base = int(times.min()) - _REACH // 2
        if int(times.max()) - self._base >= _REACH - 1:
            self._pack(counts, int(times.max()) - _REACH // 2)
        elif (self.end + counts > self.start + self.room).any():
            self._pack(counts, self._base)
        ends = np.cumsum(counts)
        at = (self.end - (ends - counts))[whose] + np.arange(len(whose))
        self.times[at] = ordered
        self.keys[at] = self._keys(whose, ordered)
        places = np.empty_like(at)
        places[order] = at
        self.samples[places] = np.fromiter(samples, object, len(samples))
        self.filled[at] = False
        self.end += counts
        late = (at > self.first[whose]) & (self.times[at] < self.times[at - 1])
        if late.any():
            for client in np.unique(whose[late]).tolist():
                self._sort(client)

    def find(self, times: Integers, clients: Integers) -> Integers:
        """The index after the last row up to each time. Shapes: (T,), (C,) to (C, T)."""
        if self._base is None:
            return np.repeat(self.end[clients][:, None], len(times), axis=1)
        keys = (clients << _SHIFT)[:, None] + _within(times - self._base, -1, _REACH - 1)
        found = self.keys.searchsorted(keys.ravel(), side="right").reshape(keys.shape)
        return _within(found, self.first[clients][:, None], self.end[clients][:, None])

    def find_each(self, times: Integers, clients: Integers) -> Integers:
        """The index after the last row of each client up to its time. Shapes: (n,), (n,) to (n,)."""
        if self._base is None:
            return self.end[clients]
        keys = (clients << _SHIFT) + _within(times - self._base, -1, _REACH - 1)
        return _within(self.keys.searchsorted(keys, side="right"), self.first[clients], self.end[clients])

    def clients_of(self, rows: Integers) -> Integers:
        """The clients of these rows."""
        clients: Integers = self.keys[rows] >> _SHIFT
        return clients

    def expire(self, horizon: int) -> None:
        """Drop rows up to the horizon (nanoseconds), but never the last row of a client."""
        if not len(self.end):
            return
        before = self.find(np.array([horizon]), np.arange(len(self.end)))[:, 0]
        self.drop(np.minimum(before, np.maximum(self.end - 1, self.first)) - self.first)

    def drop(self, counts: Integers) -> None:
        """Drop this number of each client's first rows."""
        if (counts > 0).any():
            rows = rows_between(self.first, self.first + counts)
            some = np.flatnonzero(counts > 0)
            self.dropped[some] = np.maximum(self.dropped[some], self.times[self.first[some] + counts[some] - 1])
            self.samples[rows] = None
            self.keys[rows] &= -_REACH  # the least of the client: keys ascend even where an older row comes late
            for column in self.columns:
                if column.others is not None:
                    column.others[rows] = None
            self.first = self.first + np.maximum(counts, 0)
            self.marks[:] = [np.maximum(mark, self.first) for mark in self.marks]

    def set_columns(self, count: int) -> None:
        """Set the number of columns and mark all of them as not filled."""
        self.columns = [StoredColumn(len(self.keys)) for _ in range(count)]
        self.filled[:] = False
        self.marks[:] = [self.first.copy() for _ in self.marks]

    def _keys(self, clients: NDArray[np.integer[Any]], times: Integers) -> Integers:
        assert self._base is not None  # noqa: S101  the caller set it
        return (clients.astype(np.int64) << _SHIFT) + _within(times - self._base, 0, _REACH - 2)

    def _sort(self, client: int) -> None:
        """Sort a client's rows by time; rows of equal time keep their order of arrival."""
        begin, end = int(self.first[client]), int(self.end[client])
        order = begin + np.argsort(self.times[begin:end], kind="stable")
        arrays = [self.times, self.keys, self.samples, self.filled]
        for column in self.columns:
            arrays += [column.values, column.tags, *(() if column.others is None else (column.others,))]
        for each in arrays:
            each[begin:end] = each[order]
        for mark in self.marks:
            mark[client] = begin

    def _pack(self, counts: Integers, base: int) -> None:
        """Move the rows that are still needed to new arrays, with room for at least `counts` new ones."""
        self._base = base
        live = self.end - self.first
        need = live + counts
        room = np.where(need > 0, np.maximum(_LEAST_ROOM, need + need // 4 + _BATCHES * np.minimum(counts, live)), 0)
        start = np.cumsum(room) - room
        source, target = rows_between(self.first, self.end), rows_between(start, start + live)
        size = int(room.sum())
        times = np.zeros(size, np.int64)
        times[target] = self.times[source]
        # The unused rest of a segment has the greatest key of its client, so that keys ascend.
        keys = np.repeat((np.arange(1, len(room) + 1) << _SHIFT) - 1, room)
        keys[target] = self._keys(np.repeat(np.arange(len(live)), live), times[target])
        samples, filled = np.empty(size, object), np.zeros(size, bool)
        samples[target], filled[target] = self.samples[source], self.filled[source]
        for column in self.columns:
            values, tags = np.zeros(size), np.zeros(size, np.uint8)
            values[target], tags[target] = column.values[source], column.tags[source]
            if column.others is not None:
                others = np.empty(size, object)
                others[target] = column.others[source]
                column.others = others
            column.values, column.tags = values, tags
        self.marks[:] = [start + np.maximum(mark - self.first, 0) for mark in self.marks]
        self.keys, self.times, self.samples, self.filled = keys, times, samples, filled
        self.start, self.room, self.first, self.end = start, room, start.copy(), start + live


def _within(numbers: Integers, least: Integers | int, most: Integers | int) -> Integers:
    """The same as np.clip, which takes several times as long for few numbers."""
    return np.minimum(np.maximum(numbers, least), most)


def rows_between(begin: Integers, end: Integers) -> Integers:
    """All indices of the ranges [begin, end), one range after the other; a range is empty if end is not after begin."""
    counts = np.maximum(end - begin, 0)
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    places: Integers = np.arange(total) + np.repeat(begin - (ends - counts), counts)
    return places


def sorted_rows(rows: Integers) -> Integers:
    """The rows in ascending order, each once.

    Sorts: numpy's unique hashes integers, which takes 25 times as long for ten thousand of them (numpy 2.4).
    """
    ordered = np.sort(rows)
    first: Truths = np.concatenate((ordered[:1] == ordered[:1], ordered[1:] != ordered[:-1]))
    return ordered[first]


def find_rows(ordered: Integers, wanted: Integers) -> tuple[Integers, Truths]:
    """Where each wanted row is among rows in ascending order, or would be inserted; and whether it is there."""
    at = np.searchsorted(ordered, wanted)
    found: Truths = at < len(ordered)
    found[found] = ordered[at[found]] == wanted[found]
    return at, found
