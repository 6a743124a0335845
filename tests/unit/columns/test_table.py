"""The table of a stream has the same contents as plain ordered lists of samples for each client."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from detector.engine.buffering.buffer import NEVER
from detector.engine.columns.table import LONGEST, Table, rows_between
from detector.engine.samples.sample import Arrival
from tests.driving import SECOND, START

DAY = 24 * 3600 * SECOND

_steps = st.sampled_from([0, 0, 1, SECOND, SECOND, 3 * SECOND])
_late = st.sampled_from([0, 0, 0, 1, 1, 2 * SECOND, 5 * SECOND, DAY])


class TableMachine(RuleBasedStateMachine):
    """A table and lists of samples under the same operations."""

    def __init__(self) -> None:
        super().__init__()
        self.table = Table()
        self.now = START
        self.number = 0
        self.rows: list[list[Arrival]] = []
        self.latest: list[int] = []
        self.dropped: list[int] = []
        self.read: set[int] = set()
        """The numbers of the samples whose columns were read."""
        self.mark = 0

    @initialize(clients=st.integers(1, 3))
    def begin(self, clients: int) -> None:
        self.come(clients)
        self.have_columns(1)
        self.mark = self.table.mark()

    @rule(clients=st.integers(1, 3))
    def come(self, clients: int) -> None:
        """Add clients; others are unchanged."""
        self.rows += [[] for _ in range(clients)]
        self.latest += [NEVER] * clients
        self.dropped += [NEVER] * clients
        self.table.grow(len(self.rows))

    @rule(data=st.data(), steps=st.lists(st.tuples(_steps, _late), min_size=1, max_size=30), read=st.booleans())
    def append(self, data: st.DataObject, steps: list[tuple[int, int]], read: bool) -> None:
        if read:
            self.read_from_the_mark_on(odd=False, but=-1)
        samples, clients = [], []
        for step, late in steps:
            self.now += step
            self.number += 1
            samples.append(Arrival(self.now - late, "speed", str(self.number), b""))
            clients.append(data.draw(st.integers(0, len(self.rows) - 1)))
        times = np.array([each.received for each in samples], np.int64)
        self.table.append(np.array(clients, data.draw(st.sampled_from([np.int16, np.int64]))), times, samples)
        for client, sample in zip(clients, samples, strict=True):
            rows = self.rows[client]
            rows.insert(bisect_right([each.received for each in rows], sample.received), sample)
            self.latest[client] = max(self.latest[client], sample.received)

    @rule(time=st.sampled_from([SECOND, 3600 * SECOND, 6 * 3600 * SECOND, DAY, 40 * DAY]))
    def wait(self, time: int) -> None:
        self.now += time

    @rule(keep=st.sampled_from([0, SECOND, 4 * SECOND, 3600 * SECOND]))
    def expire(self, keep: int) -> None:
        horizon = self.now - keep
        self.table.expire(horizon)
        self.forget([[each for each in rows[:-1] if each.received > horizon] + rows[-1:] for rows in self.rows])

    @rule(data=st.data())
    def drop(self, data: st.DataObject) -> None:
        counts = [data.draw(st.integers(0, len(rows))) for rows in self.rows]
        room = self.table.clients - len(counts)  # for clients to come
        self.table.drop(np.array(counts + [0] * room, np.int64))
        self.forget([rows[count:] for rows, count in zip(self.rows, counts, strict=True)])

    def forget(self, kept: list[list[Arrival]]) -> None:
        for client, (before, after) in enumerate(zip(self.rows, kept, strict=True)):
            gone = before[: len(before) - len(after)]
            self.dropped[client] = max([self.dropped[client], *(each.received for each in gone)])
        self.rows = kept

    @rule(count=st.integers(1, 2))
    def have_columns(self, count: int) -> None:
        self.table.set_columns(count)
        self.read.clear()

    @rule(odd=st.booleans(), but=st.integers(0, 3))
    def read_from_the_mark_on(self, odd: bool, but: int) -> None:
        """As windows do, of all clients but one: what lies before the mark was read already."""
        table = self.table
        clients = np.flatnonzero(np.arange(len(self.rows)) != but)
        mark = table.marks[self.mark]
        rows = rows_between(mark[clients], table.end[clients])
        for row in rows[~table.filled[rows]].tolist():
            number = int(table.samples[row].key)
            self.read.add(number)
            for column in table.columns:
                column.values[row] = number
                column.tags[row] = 4 if odd else 1
                if odd:
                    column.others = np.empty(len(column.values), object) if column.others is None else column.others
                    column.others[row] = str(number)
        table.filled[rows] = True
        mark[clients] = table.end[clients]

    @invariant()
    def rows_are_those_of_the_lists(self) -> None:
        table = self.table
        for client, rows in enumerate(self.rows):
            segment = slice(int(table.first[client]), int(table.end[client]))
            assert table.samples[segment].tolist() == rows
            assert table.times[segment].tolist() == [each.received for each in rows]
            assert int(table.dropped[client]) == self.dropped[client]
            numbers = [int(each.key) for each in rows]
            assert table.filled[segment].tolist() == [number in self.read for number in numbers]
            for column in table.columns:
                for row, number in zip(range(segment.start, segment.stop), numbers, strict=True):
                    if number in self.read:
                        assert column.values[row] == number
                        assert column.tags[row] == 1 or column.others[row] == str(number)  # type: ignore[index]
            mark = int(table.marks[self.mark][client])
            assert set(numbers[: mark - segment.start]) <= self.read
            assert segment.start <= mark <= segment.stop
        held = rows_between(table.first, table.end)
        assert table.clients_of(held).tolist() == [at for at, rows in enumerate(self.rows) for _ in rows]

    @invariant()
    def find_gives_the_place_after_the_last_row_up_to_a_time(self) -> None:
        requested = sorted({*self._times()})
        clients = np.arange(len(self.rows))
        found = self.table.find(np.array(requested, np.int64), clients) - self.table.first[clients][:, None]
        for client, rows in enumerate(self.rows):
            times = [each.received for each in rows]
            assert found[client].tolist() == [bisect_right(times, time) for time in requested]

    def _times(self) -> Iterator[int]:
        """At, before and after rows, as far back as ticks and their windows reach."""
        newest = max([*self.latest, START])
        least = newest - 2 * LONGEST + 2
        yield from (newest, newest + 1, newest + 40 * DAY, least)
        for rows in self.rows:
            for row in rows[-8:]:
                yield from (max(row.received + offset, least) for offset in (-1, 0, 1))


TestTable = TableMachine.TestCase
TestTable.settings = settings(max_examples=80, stateful_step_count=20, deadline=None)
