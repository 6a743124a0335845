"""Rules in columns: the ticks that wait to be evaluated together, and the episodes that come of them.

The rules that are due at the same ticks are a group. Ticks are collected as long as nothing happens between them that
an evaluation could see or change; how many are evaluated together never changes a result.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.conditions import Codes
from detector.engine.columns.group import Group, fits
from detector.engine.columns.pairs import fits_pairs
from detector.engine.columns.table import Integers, Truths
from detector.engine.episodes.episodes import TRUE
from detector.engine.episodes.subjects import Subject
from detector.engine.evaluation import RuleRun
from detector.engine.happened import Happened
from detector.engine.observing import Observer
from detector.engine.pairs import PairGroup
from detector.engine.scoping.scopes import Candidate
from detector.engine.timing.schedule import Only

_POINTS = 200_000
"""At most so many points are evaluated together, for all ticks and clients: the columns of all rules are in memory."""

_AGAIN = 255
"""In place of the observation before: the subject has to be looked at."""

_NEVER = np.iinfo(np.int64).max


class RuleGroup:
    """The rules that are due at the same ticks, and what was last seen of their subjects."""

    def __init__(self, runs: Sequence[RuleRun], orders: Mapping[str, int], context: Context, every: int, period: int):
        """`every` is the rules' period, `period` that at which they are evaluated: longer where some are left out."""
        self.every = every
        self.period = period
        self.runs = runs
        self.waiting: list[int] = []
        """Ticks that are not evaluated yet."""
        self.columns = Group(
            [Track(run.rule, element, run.counters, run.read) for run in runs for element in run.rule.elements], context
        )
        self.observer: Observer | None = None
        self.may_wait = True
        """Whether several ticks are evaluated together."""
        self.width = len(self.columns.tracks)
        """How many columns there are for each client."""
        self._of = [run for run in runs for _ in run.rule.elements]
        """The rule of each track."""
        self._budgeted = [run for run in runs if run.rule.maximum_per_hour is not None]
        self._deploying = [(row, run) for row, run in enumerate(self._of) if run.has_deploys]
        self._orders = [orders[run.rule.name] for run in self._of]
        self._context = context
        self._version = -1
        self._last: Codes = np.zeros((0, 0), np.uint8)
        self._wakes: Integers = np.zeros((0, 0), np.int64)
        self._watched: Truths = np.zeros((0, 0), bool)
        """Which subjects have a state of their own. These have a row for each track, a column for each client."""

    def evaluate(
        self, ticks: Sequence[int], clients: Sequence[str], floor: int | None, only: Mapping[str, Only] | None = None
    ) -> Iterator[Happened]:
        """What happens at these ticks. `only`: by rule, the subjects that it looks at; others are looked at in vain."""
        if not clients:
            return
        looked = None if only is None else self._looked(clients, only)
        block, codes = self.columns.evaluate(ticks, clients, floor, looked)
        if self.observer is not None:
            self.observer.clients(self.columns.tracks, block, codes, looked)
        self._follow()
        for row, subject_at in self._changed(block, codes, looked):
            yield from self._step(block, codes, row, subject_at)
        last = ticks[-1]
        for run in self._budgeted:
            run.tidy_starts(last)

    def _looked(self, clients: Sequence[str], only: Mapping[str, Only]) -> Truths:
        """Which track looks at which client."""
        looked = np.zeros((len(self._of), len(clients)), bool)
        for row, (run, track) in enumerate(zip(self._of, self.columns.tracks, strict=True)):
            chosen = only.get(run.rule.name)
            if chosen is not None:
                looked[row] = [chosen.takes(track.subject(client)) for client in clients]
        return looked

    def _follow(self) -> None:
        """Know all clients, and the states that changed otherwise."""
        tables = self._context.tables
        if self._version != tables.version:
            self._version = tables.version
            nobody = (len(self._of), 0)
            self._last, self._wakes = np.zeros(nobody, np.uint8), np.zeros(nobody, np.int64)
            self._watched = np.zeros(nobody, bool)
            for run in self.runs:
                run.disturbed = True
        # Before there is room for all clients: of a subject that was restored, no sample may have come yet.
        watched = {
            row: [tables.number(each.clients[0]) for each in run.subjects if each.element == track.element.name]
            for row, (run, track) in enumerate(zip(self._of, self.columns.tracks, strict=True))
            if run.disturbed
        }
        clients, room = len(tables.names), self._last.shape[1]
        if clients > room:
            more = (len(self._of), max(clients, 2 * room) - room)
            self._last = np.concatenate((self._last, np.full(more, _AGAIN, np.uint8)), axis=1)
            self._wakes = np.concatenate((self._wakes, np.full(more, _NEVER)), axis=1)
            self._watched = np.concatenate((self._watched, np.zeros(more, bool)), axis=1)
        for row, numbers in watched.items():
            self._last[row] = _AGAIN
            self._watched[row] = False
            self._watched[row, numbers] = True
        for run in self.runs:
            run.disturbed = False

    def _changed(
        self, block: Block, codes: Codes, looked: Truths | None
    ) -> Iterator[tuple[int, tuple[int, list[int]]]]:
        """By track and client, the ticks at which the observation changes or something is due, where that matters."""
        numbers, last = block.numbers, int(block.times[-1])
        changed = np.empty(codes.shape, bool)
        np.not_equal(codes[:, :, 0], self._last[:, numbers], out=changed[:, :, 0])
        np.not_equal(codes[:, :, 1:], codes[:, :, :-1], out=changed[:, :, 1:])
        watched = self._watched[:, numbers]
        changed[:, :, 0] |= self._wakes[:, numbers] <= last
        for row, run in self._deploying:
            if run.open_episodes:
                track = self.columns.tracks[row]
                for at in np.flatnonzero(watched[row]).tolist():
                    if run.needs_every_tick(track.subject(block.clients[at])):
                        changed[row, at] = True
        matters = watched | (codes & 3 == TRUE).any(axis=2)
        if looked is not None:
            matters &= looked
            kept = np.where(looked, codes[:, :, -1], self._last[:, numbers])
            self._last[:, numbers] = kept
        else:
            self._last[:, numbers] = codes[:, :, -1]
        changed &= matters[:, :, None]
        if block.present is not None:
            changed &= block.present
        flat = np.flatnonzero(changed)
        if not len(flat):
            return
        which, when = np.divmod(flat, len(block.ticks))
        bounds = [0, *(np.flatnonzero(np.diff(which)) + 1).tolist(), len(flat)]
        ticks = when.tolist()
        for begin, end in itertools.pairwise(bounds):
            row, at = divmod(int(which[begin]), len(block.clients))
            yield row, (at, ticks[begin:end])

    def _step(self, block: Block, codes: Codes, row: int, subject_at: tuple[int, list[int]]) -> Iterator[Happened]:
        """Bring one subject's state forward over all ticks of the block."""
        at, changes = subject_at
        run, track, number = self._of[row], self.columns.tracks[row], int(block.numbers[at])
        subject = track.subject(block.clients[at])
        state = run.state(subject) or run.new_state(subject)
        follows = run.has_deploys
        ticks, seen, count = block.ticks, codes[row, at], len(block.ticks)
        wake: int | None = None
        for begin, end in itertools.pairwise((*changes, count)):
            code, first = int(seen[begin]), begin
            while first < end:
                one_by_one = follows and state.is_open and run.needs_every_tick(subject)
                ran = state.run(ticks, first, first + 1 if one_by_one else end, run.timing, code)
                wake, happened_at = ran.wake, ran.at
                if ran.what is not None:
                    candidate = self._candidate(block, track, subject, at * count + happened_at)
                    event = run.happened(ticks[happened_at], ran.what, candidate)
                    if event is not None:
                        yield Happened(ticks[happened_at], self._orders[row], event)
                    happened_at += 1
                elif one_by_one:
                    run.stays(ticks[first], self._candidate(block, track, subject, at * count + first))
                first = happened_at
        if state.idle_at(ticks[-1]):
            run.drop_state(subject)
        self._watched[row, number] = run.state(subject) is not None
        self._wakes[row, number] = _NEVER if wake is None else wake

    def _candidate(self, block: Block, track: Track, subject: Subject, point: int) -> Candidate:
        return Candidate(subject, block.variables(track, point), in_scope=True, near=True)


class Blocks:
    """All rules in columns."""

    def __init__(self, context: Context, floor: Callable[[], int | None], observer: Observer | None = None) -> None:
        """`floor`: windows do not reach back to this time or beyond; nanoseconds."""
        self._observer = observer
        self._context = context
        self._floor = floor
        self._groups: list[RuleGroup | PairGroup] = []
        self._on_sample: dict[str, RuleGroup] = {}
        self.with_samples: Mapping[str, Sequence[RuleRun]] = {}
        """By stream, the rules that are evaluated with its samples."""
        self.names: frozenset[str] = frozenset()
        """The rules that are evaluated here."""

    def set_rules(
        self, runs: Mapping[str, RuleRun], paused: Collection[str], thinning: Callable[[RuleRun], int]
    ) -> None:
        """These rules are evaluated from now on; `thinning`: of so many evaluations of a rule, one takes place."""
        orders = {name: order for order, name in enumerate(runs)}
        by_times: dict[tuple[int, int], list[RuleRun]] = {}
        by_stream: dict[str, list[RuleRun]] = {}
        pairs: list[tuple[RuleRun, int]] = []
        for run in runs.values():
            rule = run.rule
            if rule.name in paused or not rule.enabled or run.alone:
                continue
            if rule.every_ns is not None and fits_pairs(rule, self._context):
                pairs.append((run, rule.every_ns))
            elif not fits(rule, self._context.tables):
                continue
            elif rule.every_ns is not None:
                by_times.setdefault((rule.every_ns, rule.every_ns * thinning(run)), []).append(run)
            elif rule.on_sample is not None:
                by_stream.setdefault(rule.on_sample, []).append(run)
        self._context.tables.forget_users()
        self._groups = [
            RuleGroup(chosen, orders, self._context, every, period) for (every, period), chosen in by_times.items()
        ]
        self._groups += [
            PairGroup(run, orders[run.rule.name], self._context, every, every * thinning(run)) for run, every in pairs
        ]
        self._on_sample = {
            stream: RuleGroup(chosen, orders, self._context, 0, 0) for stream, chosen in by_stream.items()
        }
        self.with_samples = by_stream
        groups: list[RuleGroup | PairGroup] = [*self._groups, *self._on_sample.values()]
        self.names = frozenset(run.rule.name for group in groups for run in group.runs)
        for group in groups:
            group.observer = self._observer
            for run in group.runs:
                run.disturbed = True

    def due(self, time: int) -> list[RuleGroup | PairGroup]:
        """The groups that are evaluated at a tick."""
        return [group for group in self._groups if time % group.period == 0]

    def skip(self, time: int) -> None:
        """Count the evaluations that are left out at a tick."""
        for group in self._groups:
            if group.period != group.every and time % group.every == 0 and time % group.period:
                for run in group.runs:
                    run.counters.skipped += 1

    def wait(self, time: int, groups: Iterable[RuleGroup | PairGroup]) -> bool:
        """Evaluate the groups at this tick later; whether there are so many points that it should be soon."""
        clients = len(self._context.clients)
        full = False
        for group in groups:
            group.waiting.append(time)
            full = full or len(group.waiting) * max(clients, 1) * group.width > _POINTS * 10 or not group.may_wait
        return full

    @property
    def waiting(self) -> bool:
        """Whether there are ticks that are not evaluated yet."""
        return any(group.waiting for group in self._groups)

    @property
    def since(self) -> int:
        """The first tick that is not evaluated yet; there is one."""
        return min(group.waiting[0] for group in self._groups if group.waiting)

    def run(self, stopwatch: Callable[[], int]) -> list[Happened]:
        """Evaluate all ticks that wait; what happened, in order."""
        happened: list[Happened] = []
        clients = [*self._context.clients]
        for group in self._groups:
            if group.waiting:
                ticks, group.waiting = group.waiting, []
                happened += _timed(group, ticks, stopwatch, group.evaluate(ticks, clients, self._floor()))
        happened.sort(key=lambda each: (each.time, each.order, each.event.subject))
        return happened

    def run_with_samples(
        self, stream: str, time: int, only: Mapping[str, Only], stopwatch: Callable[[], int]
    ) -> list[Happened]:
        """Evaluate the rules that are evaluated with the samples of a stream, by rule for these subjects."""
        group = self._on_sample[stream]
        present = sorted({client for each in only.values() for client in each.present(self._context.clients)})
        return _timed(group, (time,), stopwatch, group.evaluate((time,), present, self._floor(), only))


def _timed(
    group: RuleGroup | PairGroup, ticks: Sequence[int], stopwatch: Callable[[], int], happened: Iterator[Happened]
) -> list[Happened]:
    """All that happened; the time that it took is shared out among the rules."""
    begin = stopwatch()
    found = [*happened]
    spent = (stopwatch() - begin) // max(len(group.runs), 1)
    for run in group.runs:
        run.counters.timed(ticks[-1], spent, len(ticks))
    return found
