"""The signals of rules that are evaluated together, in columns; equal signals are computed once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from detector.engine.buffering.buffer import NEVER
from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.episodes import of_episodes
from detector.engine.columns.named import NamedSignals
from detector.engine.columns.reading import SampleExpression, UsedColumns
from detector.engine.columns.table import Integers, Truths, rows_between, sorted_rows
from detector.engine.columns.watching import SampleAges
from detector.engine.columns.windows import EXTREMES, Ranges, aggregated_ranges, extremes, misfits
from detector.engine.counters import Ages
from wayside.api.eventrule import OF_A_SAMPLE, Aggregate
from wayside.expressions.columns.values import Column, Tag, value_at
from wayside.rules import CompiledSignal

_ALWAYS_KNOWN: Final = frozenset({Aggregate.COUNT, Aggregate.ANY})
"""Aggregates that are known for a stale stream as well."""


class Key(NamedTuple):
    """The definition of a signal without its name: equal ones are computed once."""

    stream: str
    used: UsedColumns
    over: int | None
    aggregate: Aggregate
    quantile: float | None = None


class SignalColumns:
    """The signals of all rules of a group."""

    def __init__(
        self, context: Context, tracks: Sequence[Track], *, shared: bool = True, client: str | None = None
    ) -> None:
        """`shared`: samples without a value are counted when they are read; otherwise when a window first contains
        them.

        The first is for rules that evaluate all clients, the second for those that evaluate some. `client`: compute
        only the signals that name this client, for this client; None: all signals.
        """
        self._client = client
        self._named: dict[str, NamedSignals] = {}
        """The signals that name a client, by client."""
        self._context = context
        self._tracks = tracks
        self._keys: dict[Key, int] = {}
        self._places: dict[tuple[int, str], int] = {}
        """The indices of the signals that are computed here, by track and name."""
        self._users: list[list[tuple[int, CompiledSignal]]] = []
        """By signal: the tracks that use it, each with its name there."""
        self._over_rules: list[tuple[int, Track, CompiledSignal]] = []
        """Signals over the episodes of other rules, each with its index."""
        self._marks: dict[str, int] = {}
        """By stream, the first row that no window has contained yet: one of its table's marks."""
        self._shared = shared
        self._new: dict[int, int] = {}
        """By signal, the first row that no window of it has contained yet: one of its table's marks; only if not
        shared."""
        self._version = -1
        self.ages = SampleAges()
        self._watching: dict[str, list[Ages]] = {}
        """By stream, the ages of each rule, once per signal."""
        self._all_streams = False
        for row, track in enumerate(tracks):
            own = {signal.name: signal for signal in track.element.signals}
            for signal in track.rule.signals:
                placed = own.get(signal.name, signal)
                if client is None:
                    track.signals[signal.name] = self._place(row, placed)
                elif signal.client == client:
                    self._place(row, placed)
        self._by_stream: dict[str, list[tuple[int, Key]]] = {}
        """The signals and their indices, by the stream that they read."""
        for key, at in self._keys.items():
            self._by_stream.setdefault(key.stream, []).append((at, key))
        for name, named in self._named.items():
            named.columns = SignalColumns(context, tracks, shared=shared, client=name)
        self._nested = _nested(self._keys)
        """The signals that differ only in the length of their windows, from the shortest."""

    @property
    def count(self) -> int:
        """Number of signals."""
        return len(self._users)

    def watch_all_streams(self) -> None:
        """Compute the freshness of every stream: some rule reads it."""
        self._all_streams = True
        for stream in self._context.stale_after:
            self._context.tables.add(stream)

    def _place(self, row: int, signal: CompiledSignal) -> int:
        if signal.client != self._client:
            assert signal.client is not None  # noqa: S101  of the signals that name a client, its own ones are here
            self._users.append([(row, signal)])
            named = self._named.setdefault(signal.client, NamedSignals(signal.client))
            named.add(len(self._users) - 1, self._tracks[row], signal.name)
            return len(self._users) - 1
        self._places[row, signal.name] = at = self._place_own(row, signal)
        return at

    def _place_own(self, row: int, signal: CompiledSignal) -> int:
        if signal.rule is not None:
            self._users.append([(row, signal)])
            self._over_rules.append((len(self._users) - 1, self._tracks[row], signal))
            return len(self._users) - 1
        reader = self._context.tables.add(signal.stream)
        element = signal.element
        used = reader.use(
            None if signal.value is None else SampleExpression(signal.value, signal.parameters, element),
            None if signal.where is None else SampleExpression(signal.where, signal.parameters, element),
        )
        key = Key(signal.stream, used, signal.over_ns, signal.aggregate, signal.quantile)
        at = self._keys.setdefault(key, len(self._users))
        if at == len(self._users):
            self._users.append([])
        self._users[at].append((row, signal))
        if self._shared:
            self._context.tables.users.setdefault((signal.stream, used), []).append(
                (self._tracks[row].counters, signal)
            )
        return at

    def compute(self, block: Block, floor: int | None) -> None:
        """Compute all signals."""
        tables = self._context.tables
        if self._version != tables.version:
            self._version = tables.version
            self._marks = {stream: tables.table(stream).mark() for stream in self._by_stream}
            if not self._shared:
                rule = self._tracks[0].rule.name
                self._new = {at: tables.mark(key.stream, (rule, key)) for key, at in self._keys.items()}
        found: dict[int, Column] = {}
        for stream in self._context.stale_after if self._all_streams else self._by_stream:
            keys = self._by_stream.get(stream, ())
            high, lows = self._ranges(block, stream, {key.over for _, key in keys}, floor)
            if keys:
                self._fill(stream, block, high, [(key, lows[key.over]) for _, key in keys])
            ready = self._extremes(stream, high, lows)
            for at, key in keys:
                if not self._shared:
                    self._note_new(block, at, key, high[:, -1], lows[key.over][:, -1])
                found[at] = self._computed(block, at, key, high, lows, ready.get(at))
            self._watch(block, stream, high, keys)
        for at, track, signal in self._over_rules:
            found[at] = of_episodes(self._context, block, track, signal)
        for named in self._named.values():
            found |= named.compute(self._context, block, floor)
        block.signals = [found[at] for at in range(len(self._users))]

    def place(self, row: int, name: str) -> int:
        """The index of a track's signal that is computed here."""
        return self._places[row, name]

    def _ranges(
        self, block: Block, stream: str, overs: Iterable[int | None], floor: int | None
    ) -> tuple[Integers, dict[int | None, Integers]]:
        """The end of each point's windows as a row, and the first row for each length of window."""
        table, duration = self._context.tables.table(stream), self._context.tables.duration(stream)
        lengths = [*overs]
        after = [block.times]
        for over in lengths:
            if over is None:
                after.append(block.times - duration)
            else:
                after.append(block.times - over if floor is None else np.maximum(block.times - over, floor))
        count = len(block.ticks)
        found = table.find(np.concatenate(after), block.numbers)
        high = found[:, :count]
        first = table.first[block.numbers][:, None]
        lows: dict[int | None, Integers] = {}
        for at, over in enumerate(lengths, start=1):
            low = found[:, at * count : (at + 1) * count]
            lows[over] = np.minimum(low, np.maximum(high - 1, first)) if over is None else low
        some = high > first
        dropped = table.dropped[block.numbers][:, None]  # a cap may have evicted all rows
        before = np.where(dropped <= block.times, dropped, NEVER)
        latest = np.where(some, table.times[np.where(some, high - 1, 0)], before) if len(table.times) else before
        block.latest[stream] = latest
        limit = self._context.stale_after[stream]
        there = latest != NEVER
        fresh = there if limit is None else there & (block.times - np.where(there, latest, 0) <= limit)
        block.fresh[stream] = fresh
        if not fresh.all():
            block.stale.add(stream)
        return high, lows

    def _fill(self, stream: str, block: Block, high: Integers, windows: Sequence[tuple[Key, Integers]]) -> None:
        """Read the samples that the windows need."""
        tables = self._context.tables
        table, reader = tables.table(stream), tables.readers[stream]
        if not reader.count or not len(table.keys):
            return
        if block.present is not None:  # no rule evaluates a client where it is not known
            windows = [(key, np.where(block.present, low, high)) for key, low in windows]
        rows: list[Integers] = []
        whole = [low for key, low in windows if _needs_all(key)]
        if whole:
            low = whole[0] if len(whole) == 1 else np.minimum.reduce(whole)
            mark = table.marks[self._marks[stream]]
            begin = mark[block.numbers][:, None]
            seen = high
            if block.present is not None:
                seen = np.maximum.accumulate(np.where(block.present, high, begin), axis=1)
            before = np.concatenate((begin, seen[:, :-1]), axis=1)
            rows.append(rows_between(np.maximum(low, before).ravel(), high.ravel()))
            mark[block.numbers] = seen[:, -1]
        for key, low in windows:
            if not _needs_all(key) and key.used.value is not None:
                at, some = _row(key.aggregate, low, high)
                rows.append(sorted_rows(at[some]))
                if key.aggregate is Aggregate.PREVIOUS:
                    rows.append(sorted_rows(high[high > low] - 1))
        wanted = rows[0] if len(rows) == 1 else sorted_rows(np.concatenate(rows)) if rows else np.zeros(0, np.int64)
        wanted = wanted[~table.filled[wanted]]
        if len(wanted):
            tables.note_failures(stream, reader.read(table, wanted))

    def _note_new(self, block: Block, at: int, key: Key, high: Integers, low: Integers) -> None:
        """Count samples without a value that are new in a window; high and low are those of the last tick."""
        tables = self._context.tables
        table = tables.table(key.stream)
        if key.used == UsedColumns(None, None) or not len(table.keys):
            return
        if not _needs_all(key):
            if key.aggregate is Aggregate.FIRST:
                high = np.minimum(high, low + 1)
            else:
                low = np.maximum(low, high - (1 if key.aggregate is Aggregate.LAST else 2))
        if key.aggregate not in _ALWAYS_KNOWN:
            high = np.where(block.fresh[key.stream][:, -1], high, low)
        mark = table.marks[self._new[at]]
        rows = rows_between(np.maximum(low, mark[block.numbers]), high)
        mark[block.numbers] = np.maximum(mark[block.numbers], high)
        failures = [*tables.readers[key.stream].failures(table, rows, key.used)]
        for row, signal in self._users[at] if failures else ():
            tables.note(self._tracks[row].counters, signal, failures)

    def _extremes(self, stream: str, high: Integers, lows: Mapping[int | None, Integers]) -> dict[int, Column]:
        """The signals of the stream whose windows are computed together."""
        table, found = self._context.tables.table(stream), dict[int, Column]()
        for family in self._nested.get(stream, ()):
            key = family[0][1]
            column = table.columns[key.used.value or 0]
            if not column.odd and column.others is None:
                columns = extremes(key.aggregate, column.values, [lows[each.over] for _, each in family], high)
                found |= {at: computed for (at, _), computed in zip(family, columns, strict=True)}
        return found

    def _computed(
        self,
        block: Block,
        at: int,
        key: Key,
        high: Integers,
        lows: Mapping[int | None, Integers],
        ready: Column | None = None,
    ) -> Column:
        """A signal at all points; `ready`: its windows, if they are computed already."""
        if key.aggregate is Aggregate.AGE:
            return self._age(block, key)
        table, low = self._context.tables.table(key.stream), lows[key.over]
        if key.used.value is None and key.used.where is None:  # Count
            column = Column((high - low).ravel().astype(float), None, None)
        elif ready is not None:
            column = ready
        else:
            value = None if key.used.value is None else table.columns[key.used.value]
            rows = Ranges(
                np.zeros(len(table.times)) if value is None else value.values,
                None if value is None or not value.odd else value.tags,
                None if value is None else value.others,
                table.times,
                low,
                high,
            )
            if key.used.where is not None:
                where, begin = table.columns[key.used.where], rows.begin
                part = slice(begin, begin + len(rows.values))
                rows.picked((where.tags[part] == Tag.BOOLEAN) & (where.values[part] == 1))
            found = misfits(key.aggregate, rows)
            if found is not None:
                self._note_misfits(block, at, key, rows, *found)
            column = aggregated_ranges(key.aggregate, rows, self._context.tables.texts, key.quantile)
        if key.aggregate in _ALWAYS_KNOWN:
            return column
        fresh = block.fresh[key.stream].ravel()
        if key.stream in block.stale:
            tags = Tag.NUMBER if column.tags is None else column.tags
            column = Column(column.values, np.where(fresh, tags, Tag.ABSENT).astype(np.uint8), column.others)
        self._note_unknown_signal(block, at, key, column, fresh)
        return column

    def _age(self, block: Block, key: Key) -> Column:
        clients = self._context.clients
        since = np.array([clients.since(client) for client in block.clients], np.int64)
        latest = block.latest[key.stream]
        begin = np.where(latest == NEVER, since[:, None], latest)
        return Column(((block.times - begin) / 1e9).ravel(), None, None)

    def _note_misfits(self, block: Block, at: int, key: Key, rows: Ranges, counts: Integers, odd: Truths) -> None:
        """Count values of the wrong kind as errors, at each evaluation whose window contains them."""
        fresh = block.fresh[key.stream].ravel() if key.aggregate not in _ALWAYS_KNOWN else np.ones(len(counts), bool)
        counts = np.where(fresh, counts, 0)
        if block.present is not None:
            counts = np.where(block.present.ravel(), counts, 0)
        if not counts.any():
            return
        point = block.last(np.flatnonzero(counts))
        window = slice(int(rows.low.flat[point]), int(rows.high.flat[point]))
        worst = window.start + int(np.flatnonzero(odd[window])[-1])
        value = value_at(Column(rows.values, rows.tags, rows.others), worst, self._context.tables.texts)
        wanted = "booleans" if key.aggregate in (Aggregate.ANY, Aggregate.ALL) else "numbers"
        for row, signal in self._users[at]:
            own, counters = block.points(row), self._tracks[row].counters
            counters.errors += int(counts.sum() if own is None else counts[own].sum())
            place = f"signal {signal.name} of {block.clients[point // len(block.ticks)]}, stream {key.stream}"
            counters.last_error = f"{place}: {key.aggregate} needs {wanted}; got {value!r:.80}"

    def _note_unknown_signal(self, block: Block, at: int, key: Key, column: Column, fresh: Truths) -> None:
        if column.tags is None:
            return
        unknown = column.tags == Tag.ABSENT
        possible = self._context.possible
        if possible.limited:
            never = np.array([not possible(key.stream, client) for client in block.clients], bool)
            unknown &= fresh | ~np.repeat(never, len(block.ticks))
        if unknown.any():
            for row, _ in self._users[at]:
                self._tracks[row].counters.unknowns += block.count(row, unknown)

    def _watch(self, block: Block, stream: str, high: Integers, keys: Sequence[tuple[int, Key]]) -> None:
        """Note the ages of the newest samples, if ages are measured."""
        if stream not in self._watching:
            used = [row for at, key in keys if key.aggregate is not Aggregate.AGE for row, _ in self._users[at]]
            found = (self._tracks[row].counters.ages for row in used)
            self._watching[stream] = [ages for ages in found if ages is not None]
        watching = self._watching[stream]
        if watching:
            fresh, tables = block.fresh[stream], self._context.tables
            seen = fresh if block.present is None else fresh & block.present
            self.ages.used(
                watching, stream, tables.table(stream), tables.duration(stream), block, high, block.latest[stream], seen
            )


def _nested(keys: Mapping[Key, int]) -> Mapping[str, Sequence[Sequence[tuple[int, Key]]]]:
    """By stream, the signals that are Min or Max of the same column over several lengths."""
    families: dict[tuple[str, UsedColumns, Aggregate], list[tuple[int, Key]]] = {}
    for key, at in sorted(keys.items(), key=lambda each: each[0].over or 0):
        if key.aggregate in EXTREMES and key.used.where is None and key.over is not None:
            families.setdefault((key.stream, key.used, key.aggregate), []).append((at, key))
    found: dict[str, list[Sequence[tuple[int, Key]]]] = {}
    for (stream, _, _), family in families.items():
        if len(family) > 1:
            found.setdefault(stream, []).append(family)
    return found


def _needs_all(key: Key) -> bool:
    """Whether a signal needs all samples of its windows."""
    if key.used.where is not None:
        return True
    return key.used.value is not None and key.aggregate not in OF_A_SAMPLE


def _row(aggregate: Aggregate, low: Integers, high: Integers) -> tuple[Integers, Truths]:
    """The one row of each range that determines the result, and which ranges have one."""
    if aggregate is Aggregate.FIRST:
        return low, high > low
    back = 1 if aggregate is Aggregate.LAST else 2
    return high - back, high - low >= back
