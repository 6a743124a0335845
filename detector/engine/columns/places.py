"""The places of clients, in columns: see `detector.engine.scoping.positions`, which defines invalid ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from detector.engine.columns.block import Block, Context
from detector.engine.columns.reading import SampleExpression
from detector.engine.columns.table import Integers, Table, Truths, sorted_rows
from detector.engine.columns.watching import SampleAges
from detector.engine.counters import RuleCounters
from detector.engine.scoping.positions import FARTHEST, LIMITS, Place, distance, point
from wayside.expressions.columns.values import Doubles, Tag
from wayside.rules import CompiledPosition


class Places(NamedTuple):
    """Places of some clients, or of some clients at some times."""

    axes: Doubles
    """Shape (axes, n); metres or degrees."""
    known: Truths
    """Which places are known; the values of the others are arbitrary."""

    def of(self, at: Integers) -> Places:
        """Select the places at these indices, in this order."""
        return Places(np.take(self.axes, at, axis=1), self.known[at])

    def place(self, at: int) -> Place:
        """One of them."""
        return tuple(self.axes[:, at].tolist())


class PositionColumns:
    """Looks up a position of many clients in the table of its stream."""

    def __init__(self, position: CompiledPosition, context: Context, counters: RuleCounters, ages: SampleAges) -> None:
        """`ages` are those of the rule's signals, if they are measured."""
        reader = context.tables.add(position.stream)
        uses = [reader.use(SampleExpression(each, position.parameters, None), None) for each in position.axes.values()]
        self._columns = [use.value for use in uses if use.value is not None]
        self._limits = np.array([[LIMITS.get(axis, FARTHEST)] for axis in position.axes])
        self._position = position
        self._context = context
        self._counters = counters
        self._ages = ages

    def now(self, block: Block) -> tuple[Places, Integers]:
        """The places of the block's clients at its only tick, from their newest samples; also the rows of these
        samples.

        If a client has no sample, its row is meaningless and its place unknown.
        """
        table, numbers, stream = self._table, block.numbers, self._position.stream
        high = table.find(block.times, numbers)[:, 0]
        fresh = high > table.first[numbers]
        rows = np.where(fresh, high - 1, 0)
        limit = self._context.positions.limit(self._position)
        if limit is not None and fresh.any():
            fresh &= block.times[0] - table.times[rows] <= limit
        self._note_missing(block, fresh)
        if self._counters.ages is not None and fresh.any():
            duration, latest = self._context.tables.duration(stream), table.times[rows][:, None]
            seen = fresh[:, None]
            self._ages.used([self._counters.ages], stream, table, duration, block, high[:, None], latest, seen)
        at = np.flatnonzero(fresh)
        read = self._read(table, block, at, rows[at])
        axes, known = np.zeros((len(self._columns), len(numbers))), np.zeros(len(numbers), bool)
        axes[:, at], known[at] = read
        return Places(axes, known), rows

    def times(self, rows: Integers) -> Integers:
        """The times of the samples in the given rows."""
        times: Integers = self._table.times[rows]
        return times

    def then(self, block: Block, newest: Integers, at: Integers, times: Integers, floor: int | None) -> Places:
        """The places of clients, given by their indices in the block, at these times; `newest` is the result of `now`.

        Windows start after `floor`.
        """
        table, numbers = self._table, block.numbers[at]
        rows = table.find_each(times, numbers) - 1
        there = rows >= table.first[numbers]
        rows = np.where(there, rows, 0)
        received = table.times[rows]
        horizon = block.times[0] - self._context.tables.duration(self._position.stream)
        there &= (rows == newest[at]) | (received > horizon)
        if floor is not None:
            there &= received > floor
        limit = self._context.positions.limit(self._position)
        if limit is not None:
            there &= times - received <= limit
        # Each sample is read once, and each client without one is counted once.
        _, first, inverse = np.unique(np.where(there, rows, -1 - at), return_index=True, return_inverse=True)
        self._counters.unknowns += int((~there[first]).sum())
        axes, known = np.zeros((len(self._columns), len(first))), np.zeros(len(first), bool)
        some = np.flatnonzero(there[first])
        axes[:, some], known[some] = self._read(table, block, at[first[some]], rows[first[some]])
        return Places(axes, known).of(inverse)

    def distances(self, one: Places, other: Places) -> Doubles:
        """Metres between the places with the same index, computed as by `positions.distance`; both must be known."""
        both = np.flatnonzero(one.known & other.known)
        found = np.zeros(len(one.known))
        if self._position.geographic:
            places = zip(one.axes[:, both].T.tolist(), other.axes[:, both].T.tolist(), strict=True)
            found[both] = [distance(self._position, tuple(p), tuple(q)) for p, q in places]
            return found
        for p, q in zip(one.axes, other.axes, strict=True):
            along = p - q
            found += along * along
        return np.sqrt(found)

    def points(self, places: Places, at: Integers) -> Doubles:
        """Shape (n, 2 or 3): the known places of these clients in the form that a search takes."""
        if self._position.geographic:
            return np.array([point(self._position, tuple(each)) for each in places.axes[:, at].T.tolist()])
        return places.axes[:, at].T

    @property
    def _table(self) -> Table:
        return self._context.tables.table(self._position.stream)

    def _note_missing(self, block: Block, fresh: Truths) -> None:
        possible = self._context.possible
        if not possible.limited:
            self._counters.unknowns += int((~fresh).sum())
            return
        missing = np.flatnonzero(~fresh).tolist()
        self._counters.unknowns += sum(possible(self._position.stream, block.clients[at]) for at in missing)

    def _read(self, table: Table, block: Block, at: Integers, rows: Integers) -> tuple[Doubles, Truths]:
        """The places in rows of some clients, and which of them are known."""
        tables, stream = self._context.tables, self._position.stream
        wanted = sorted_rows(rows[~table.filled[rows]])
        if len(wanted):
            tables.note_failures(stream, tables.readers[stream].read(table, wanted))
        axes = np.stack([table.columns[column].values[rows] for column in self._columns])
        known: Truths = np.all(np.abs(axes) <= self._limits, axis=0)
        for column in self._columns:
            if table.columns[column].odd:
                known = known & (table.columns[column].tags[rows] == Tag.NUMBER)
        for strange in np.flatnonzero(~known).tolist():
            client, sample = block.clients[at[strange]], table.samples[rows[strange]]
            place = self._context.positions.of(self._position, client, sample, self._counters)
            if place is not None:
                axes[:, strange], known[strange] = place, True
        axes[:, ~known] = 0.0
        return axes, known
