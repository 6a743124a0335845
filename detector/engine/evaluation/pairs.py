"""A rule about pairs in columns: advances the states of its pairs only where an observation changes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.pairs import PairBlock, PairColumns
from detector.engine.columns.table import Integers, Truths, find_rows
from detector.engine.episodes.episodes import NO_WAKE, TRUE, UNSEEN
from detector.engine.episodes.events import OrderedEvent
from detector.engine.episodes.subjects import Subject
from detector.engine.evaluation.observing import Observer
from detector.engine.evaluation.rule import RuleRun
from detector.engine.scoping.scopes import Candidate
from detector.engine.timing.schedule import SubjectFilter

_SHIFT = 32


class TrackedPairs(NamedTuple):
    """The pairs that have a state, in any order."""

    keys: Integers
    """The numbers of both clients, packed into one integer."""
    last: NDArray[np.uint8]
    """The previous observation."""
    wakes: Integers
    """When to evaluate the pair again although nothing changes; nanoseconds."""
    in_progress: Truths
    """Whether an episode is open or pending; otherwise the pair is in its cooldown."""
    matters: NDArray[np.uint8]
    """The bits of an observation that count: those that end an open episode, else those that start one."""

    def of(self, at: Integers | Truths) -> TrackedPairs:
        """Select the pairs at these indices."""
        return TrackedPairs(self.keys[at], self.last[at], self.wakes[at], self.in_progress[at], self.matters[at])


Entry = tuple[int, int, int, bool, int]
"""One pair of `TrackedPairs`."""

_NOBODY = TrackedPairs(
    np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.int64), np.zeros(0, bool), np.zeros(0, np.uint8)
)

_STARTS, _ENDS = 3, 12


class PairGroup:
    """A rule about pairs, with the interface of `RuleGroup`."""

    width = 1
    may_wait = False  # samples that cannot be read are counted at each tick that reads them

    def __init__(self, run: RuleRun, order: int, context: Context, every: int, period: int) -> None:
        """`order` is the rule's position among the rules; for the other arguments see `RuleGroup`."""
        self.every = every
        self.period = period
        self.runs: Sequence[RuleRun] = (run,)
        self.waiting: list[int] = []
        self._run = run
        self._order = order
        self._context = context
        self._element = run.rule.elements[0]
        self._track = Track(run.rule, self._element, run.counters, run.read, 0, run.earlier)
        self._columns = PairColumns(self._track, context)
        self.observer: Observer | None = None
        self._watched = _NOBODY
        self._version = -1
        self._clients: Sequence[str] = ()
        self._numbers: Integers = np.zeros(0, np.int64)
        """The clients' numbers in this version of the tables."""
        self._numbered = -1

    def evaluate(
        self,
        ticks: Sequence[int],
        clients: Sequence[str],
        floor: int | None,
        only: Mapping[str, SubjectFilter] | None = None,
    ) -> list[OrderedEvent]:
        """Evaluate these ticks; returns what happened. Such a rule evaluates all pairs."""
        assert only is None  # noqa: S101  it is not evaluated with samples
        happened = [each for tick in ticks for each in self._tick(tick, clients, floor)]
        self._run.budget.expire(ticks[-1])
        return happened

    def _tick(self, tick: int, clients: Sequence[str], floor: int | None) -> Iterator[OrderedEvent]:
        block = self._block(tick, clients)
        self._follow()
        watched, count = self._watched, len(block.clients)
        index = np.full(len(self._context.tables.names), -1)
        index[block.numbers] = np.arange(count)
        first, second = index[watched.keys >> _SHIFT], index[watched.keys & (1 << _SHIFT) - 1]
        there = (first >= 0) & (second >= 0)
        look = watched.in_progress & there
        these = self._columns.evaluate(block, floor, (first[look], second[look]))
        if self.observer is not None:
            self.observer.pairs(self._track, these)
        # Where each watched pair is among the evaluated ones.
        pairs = these.first * count + these.second
        rows, seen = find_rows(pairs, first * count + second)
        seen &= there
        rows = rows[seen]
        changed = these.codes & 3 == TRUE
        differs = (these.codes[rows] ^ watched.last[seen]) & watched.matters[seen] != 0
        changed[rows] = differs | (watched.wakes[seen] <= tick)
        changed[rows] |= self._followed(these, rows, watched.in_progress[seen])
        stale = seen.copy()
        stale[seen] = changed[rows]
        over = ~seen & ~watched.in_progress & (watched.wakes <= tick)
        for key in watched.keys[over].tolist():
            del self._run.states[self._subject(key)]
        if these.measured:
            self._measure(tick, these, index)
        kept: list[Entry] = []
        for row in np.flatnonzero(changed).tolist():
            yield from self._step(tick, these, row, kept)
        self._watched = _joined(watched.of(~stale & ~over), kept)

    def _measure(self, tick: int, these: PairBlock, index: Integers) -> None:
        """Add the tick to the statistics of the open episodes; `index`: the clients' indices in the block."""
        tables, count = self._context.tables, len(these.block.clients)
        pairs = these.first * count + these.second
        for subject, statistics in self._run.measured.items():
            first, second = (int(index[tables.number(client)]) for client in subject.clients)
            row = int(np.searchsorted(pairs, first * count + second))
            if min(first, second) >= 0 and row < len(pairs) and pairs[row] == first * count + second:
                statistics.add(tick, self._columns.measured(these, row), self._run.counters)

    def _block(self, tick: int, clients: Sequence[str]) -> Block:
        """The clients that are known at the tick."""
        known, tables = self._context.clients, self._context.tables
        if known.newest > tick:
            clients = [client for client in clients if known.since(client) <= tick]
        if self._numbered != tables.version or clients != self._clients:
            self._clients, self._numbered = clients, tables.version
            self._numbers = np.array([tables.number(client) for client in clients], np.int64)
        return Block(self._context, (tick,), clients, self._numbers)

    def _follow(self) -> None:
        """Pick up states that changed elsewhere."""
        run, tables = self._run, self._context.tables
        if self._version == tables.version and not run.disturbed:
            return
        self._version, run.disturbed = tables.version, False
        found = []
        for subject, state in run.states.items():
            a, b = (tables.number(client) for client in subject.clients)
            in_progress = state.is_open or state.onset is not None
            wake = 0 if in_progress else state.rests_until
            found.append((a << _SHIFT | b, UNSEEN, wake, in_progress, _ENDS if state.is_open else _STARTS))
        self._watched = _joined(_NOBODY, found)

    def _subject(self, key: int) -> Subject:
        names = self._context.tables.names
        return Subject((names[key >> _SHIFT], names[key & (1 << _SHIFT) - 1]), self._element.name)

    def _key(self, these: PairBlock, row: int) -> int:
        numbers = these.block.numbers
        return numbers.item(these.first.item(row)) << _SHIFT | numbers.item(these.second.item(row))

    def _followed(self, these: PairBlock, rows: Integers, in_progress: Truths) -> Truths:
        """Which of these pairs have demands that an evaluation may change although the observation is the same."""
        run = self._run
        if not run.rule.deploys or not run.open_episodes:
            return np.zeros(len(rows), bool)
        needed = [
            progress and run.needs_every_tick(self._subject(self._key(these, row)))
            for row, progress in zip(rows.tolist(), in_progress.tolist(), strict=True)
        ]
        return np.array(needed, bool)

    def _step(self, tick: int, these: PairBlock, row: int, kept: list[Entry]) -> Iterator[OrderedEvent]:
        """Advance one pair's state, and add it to the kept ones if it is still needed."""
        run, key, code = self._run, self._key(these, row), these.codes.item(row)
        subject = self._subject(key)
        state = run.state(subject)
        stays = state.is_open and run.needs_every_tick(subject)
        _, what, wakes = state.run((tick,), 0, 1, run.timing, code)
        if what is not None or stays:
            measured = self._columns.measured(these, row)
            variables = self._columns.happened(these, row)
            candidate = Candidate(subject, variables, in_scope=True, near=True, measured=measured)
            if what is None:
                run.stays(tick, candidate)
            elif (event := run.happened(tick, what, candidate)) is not None:
                yield OrderedEvent(tick, self._order, event)
        if state.idle_at(tick):
            del run.states[subject]
            return
        in_progress = state.is_open or state.onset is not None
        wake = wakes if in_progress else state.rests_until
        matters = _ENDS if state.is_open else _STARTS
        kept.append((key, code, NO_WAKE if wake is None else wake, in_progress, matters))


def _joined(watched: TrackedPairs, more: Sequence[Entry]) -> TrackedPairs:
    if not more:
        return watched
    keys, last, wakes, in_progress, matters = zip(*more, strict=True)
    return TrackedPairs(
        np.append(watched.keys, np.array(keys, np.int64)),
        np.append(watched.last, np.array(last, np.uint8)),
        np.append(watched.wakes, np.array(wakes, np.int64)),
        np.append(watched.in_progress, np.array(in_progress, bool)),
        np.append(watched.matters, np.array(matters, np.uint8)),
    )
