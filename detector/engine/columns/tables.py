"""The tables of all streams that rules read, synchronised with the buffer.

Samples that enter the buffer are added before rules are evaluated. Samples that the buffer evicts early, by a cap or
with a client that is forgotten, are dropped from the tables as well.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from detector.engine.buffering.buffer import NEVER, Buffer, Lane
from detector.engine.buffering.messages import Messages
from detector.engine.columns.reading import Failure, Reader, UsedColumns
from detector.engine.columns.table import LONGEST, MAXIMUM_CLIENTS, Integers, Table
from detector.engine.counters import Counters, RuleCounters
from detector.engine.samples.sample import Decoder, Sample
from wayside.api import Detector
from wayside.api.stream import Stream
from wayside.expressions.columns.values import Texts
from wayside.rules import CompiledSignal

_MAXIMUM_TEXTS = 1_000_000
"""Maximum number of distinct texts; beyond it, tables are rebuilt, because texts are never forgotten one by one."""

_SPARE_COLUMNS = 16
"""Number of unused columns that are tolerated."""


class Tables:
    """Tables by stream, and numbers by client."""

    def __init__(self, buffer: Buffer) -> None:
        self._buffer = buffer
        self._numbers: dict[str, int] = {}
        self.names: list[str] = []
        """The clients' names, by their numbers."""
        self.texts = Texts()
        self._tables: dict[str, Table] = {}
        self.readers: dict[str, Reader] = {}
        self._durations: dict[str, int] = {}
        self._evictions = buffer.evictions
        self._stale = True
        self._used: set[tuple[str, Hashable]] = set()
        """The marks requested since the rules were set, by stream and owner."""
        self._marks: dict[tuple[str, Hashable], int] = {}
        self.users: dict[tuple[str, UsedColumns], list[tuple[RuleCounters, CompiledSignal]]] = {}
        """The users of a stream's columns."""
        self.version = 0
        """Changes when tables are rebuilt, which invalidates earlier indices and numbers."""

    def configure(
        self, detector: Detector, decoders: Mapping[str, Decoder], messages: Messages, counters: Counters
    ) -> None:
        """Switch to this Detector. Tables are created on first use."""
        self._detector, self._decoders, self._messages, self._counters = detector, decoders, messages, counters
        self._tables, self.readers = {}, {}
        self._durations = {stream.name: detector.spec.buffer_duration_ns(stream) for stream in detector.spec.streams}
        self.forget()

    def follow(self, other: Tables) -> None:
        """Use the Detector of the other tables."""
        self.configure(other._detector, other._decoders, other._messages, other._counters)

    def forget_users(self) -> None:
        """Release all columns and marks, except the marks whose owners requested them since the last call."""
        self.users.clear()
        kept = {name: self._tables[name[0]].marks[at] for name, at in self._marks.items() if name in self._used}
        self._marks.clear()
        self._used.clear()
        for table in self._tables.values():
            table.marks.clear()
        for (stream, owner), mark in kept.items():
            self._marks[stream, owner] = len(self._tables[stream].marks)
            self._tables[stream].marks.append(mark)

    def forget(self) -> None:
        """Rebuild all tables from the buffer when they are next needed."""
        self._stale = True

    def add(self, stream: str) -> Reader:
        """Keep a table of the stream from now on; returns the reader of its columns."""
        if stream not in self._tables:
            self._tables[stream] = Table()
            self.readers[stream] = Reader(
                stream, self._decoders[stream], self.texts, self._messages, self._counters, self.names
            )
            self._stale = True
        return self.readers[stream]

    def table(self, stream: str) -> Table:
        """The stream's table."""
        return self._tables[stream]

    def mark(self, stream: str, owner: Hashable) -> int:
        """The owner's mark in the stream's table: the same one at each call, until tables are rebuilt."""
        self._used.add((stream, owner))
        if (stream, owner) not in self._marks:
            self._marks[stream, owner] = self._tables[stream].mark()
        return self._marks[stream, owner]

    def number(self, client: str) -> int:
        """The client's number."""
        number = self._numbers.get(client)
        if number is None:
            number = self._numbers[client] = len(self.names)
            self.names.append(client)
            for table in self._tables.values():
                table.grow(len(self.names))
        return number

    @property
    def full(self) -> bool:
        """Whether the numbers of clients or texts are used up: the caller then makes new tables."""
        return len(self.names) >= MAXIMUM_CLIENTS - 1 or len(self.texts) > _MAXIMUM_TEXTS

    @property
    def wasteful(self) -> bool:
        """Whether most columns are unused: the caller then makes new tables."""
        used = {(stream, at) for stream, each in self.users for at in each if at is not None}
        return sum(reader.count for reader in self.readers.values()) > 2 * len(used) + _SPARE_COLUMNS

    @property
    def streams(self) -> Sequence[Stream]:
        """The Detector's streams."""
        return self._detector.spec.streams

    @property
    def empty(self) -> bool:
        """Whether no rule reads any column."""
        return not self._tables

    def supports(self, stream: Stream) -> bool:
        """Whether windows over the stream can be ranges of a table."""
        capped = stream.buffer.bytes is not None or stream.buffer.count is not None
        return not stream.latched and not capped and self._durations[stream.name] <= LONGEST

    def duration(self, stream: str) -> int:
        """The retention of the stream's samples, in nanoseconds."""
        return self._durations[stream]

    @property
    def behind(self) -> bool:
        """Whether the buffer has dropped samples that are still in the tables."""
        return self._stale or self._evictions != self._buffer.evictions

    def update(self, samples: list[Sample], lanes: list[Lane]) -> None:
        """Add the samples that entered the buffer since the last call, each with its lane; drop evicted ones."""
        for table, reader in zip(self._tables.values(), self.readers.values(), strict=True):
            if len(table.columns) != reader.count:
                table.set_columns(reader.count)
        if self._stale:
            self._rebuild()
            return
        if samples:
            self._append(samples, lanes)
        if self.behind:
            self._follow_evictions()

    def expire(self, now: int) -> None:
        """Drop the rows that have expired in the buffer; nanoseconds."""
        if not self._stale:
            for stream, table in self._tables.items():
                table.expire(now - self._durations[stream])

    def note_failures(self, stream: str, failures: Mapping[UsedColumns, Sequence[Failure]]) -> None:
        """Count samples without a value, for every rule that has the signal."""
        for used, found in failures.items():
            for counters, signal in self.users.get((stream, used), ()):
                self.note(counters, signal, found)

    def note(self, counters: RuleCounters, signal: CompiledSignal, failures: Sequence[Failure]) -> None:
        """Count samples without a value for a signal."""
        for failure in failures:
            if signal.client is not None and signal.client != self.names[failure.client]:
                continue
            if failure.reason is None:
                counters.unknowns += failure.samples
            else:
                place = f"signal {signal.name} of {self.names[failure.client]}, stream {signal.stream}"
                counters.note(failure.reason, failure.message, place, failure.samples)

    def _append(self, samples: list[Sample], lanes: list[Lane]) -> None:
        numbers = np.fromiter([lane.number for lane in lanes], np.int64, len(lanes))
        if numbers.min() < 0:
            for lane in dict.fromkeys(lanes):
                lane.number = self.number(lane.client)
            numbers = np.fromiter([lane.number for lane in lanes], np.int64, len(lanes))
        if len(self.names) < 2**15:
            numbers = numbers.astype(np.int16)  # sorted faster
        times = np.fromiter([sample.received for sample in samples], np.int64, len(samples))
        streams = {lane.stream for lane in set(lanes)}
        for stream in streams & self._tables.keys():
            if len(streams) == 1:
                self._tables[stream].append(numbers, times, samples)
            else:
                of = np.array([lane.stream == stream for lane in lanes])
                at = np.flatnonzero(of)
                self._tables[stream].append(numbers[at], times[at], [samples[each] for each in at.tolist()])

    def _rebuild(self) -> None:
        self._stale = False
        self._numbers.clear()
        self.names.clear()
        self._marks.clear()
        for stream, reader in self.readers.items():
            table = self._tables[stream] = Table()
            table.set_columns(reader.count)
        by_stream: dict[str, list[Lane]] = {stream: [] for stream in self._tables}
        for lane in self._buffer:
            lane.number = self.number(lane.client)
            if lane.stream in by_stream:
                by_stream[lane.stream].append(lane)
        for stream, lanes in by_stream.items():
            table = self._tables[stream]
            table.grow(len(self.names))
            samples = [sample for lane in lanes for sample in lane.samples]
            numbers = np.array([lane.number for lane in lanes for _ in lane.samples], np.int64)
            table.append(numbers, np.fromiter([sample.received for sample in samples], np.int64, len(samples)), samples)
            for lane in lanes:
                table.dropped[lane.number] = NEVER if lane.samples else lane.latest
        self._evictions = self._buffer.evictions
        self.version += 1

    def _follow_evictions(self) -> None:
        """Drop the rows whose samples the buffer has evicted."""
        self._evictions = self._buffer.evictions
        for stream, table in self._tables.items():
            kept: Integers = np.zeros(table.clients, np.int64)
            there = np.zeros(table.clients, bool)
            for lane in self._buffer:
                if lane.stream == stream and lane.number >= 0:
                    kept[lane.number], there[lane.number] = len(lane.samples), True
            table.drop(np.maximum(table.end - table.first - kept, 0))
            table.dropped[~there] = NEVER
