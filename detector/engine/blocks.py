"""Rules in columns: the ticks that wait to be evaluated together, and the episodes that come of them.

The rules that are due at the same ticks are a group. Ticks are collected as long as nothing happens between them that
an evaluation could see or change; how many are evaluated together never changes a result.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.fleets import FleetBlock, FleetGroup, fits_fleet
from detector.engine.columns.group import Group, fit_signals, fits, signals_of
from detector.engine.columns.pairs import fits_pairs
from detector.engine.columns.table import Integers, Truths
from detector.engine.columns.verdicts import Codes
from detector.engine.episodes.episodes import TRUE
from detector.engine.episodes.subjects import Subject
from detector.engine.evaluation import RuleRun
from detector.engine.happened import Happened
from detector.engine.observing import Observer
from detector.engine.pairs import PairGroup
from detector.engine.scoping.scopes import Candidate
from detector.engine.timing.schedule import Only
from wayside.rules import CompiledRule, episode_stream

_POINTS = 200_000
"""Maximum number of points, for all ticks and clients, in a block: the columns of all rules are in memory."""

_AGAIN = 255
"""In place of the observation before: the subject has to be looked at."""

_NEVER = np.iinfo(np.int64).max


class Changes(NamedTuple):
    """When a subject has to be looked at, by the block's ticks, and its observations then."""

    row: int
    """The subject's track."""
    at: int
    """Its place among the block's clients."""
    ticks: list[int]
    codes: list[int]


class RuleGroup:
    """The rules that are due at the same ticks, and what was last seen of their subjects."""

    def __init__(
        self,
        runs: Sequence[RuleRun],
        orders: Mapping[str, int],
        context: Context,
        every: int,
        period: int,
        columns: type[Group | FleetGroup] = Group,
    ) -> None:
        """`every` is the rules' period, `period` that at which they are evaluated: longer where some are left out."""
        self.every = every
        self.period = period
        self.runs = runs
        self.waiting: list[int] = []
        """Ticks that are not evaluated yet."""
        elements = [(run, element) for run in runs for element in run.rule.elements]
        self.columns = columns(
            [Track(run.rule, each, run.counters, run.read, row) for row, (run, each) in enumerate(elements)], context
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
        if not clients and self.columns.needs_clients:
            return
        looked = None if only is None else self._looked(clients, only)
        block, codes = self.columns.evaluate(ticks, clients, floor, looked)
        if self.observer is not None:
            if isinstance(block, Block):
                self.observer.clients(self.columns.tracks, block, codes, looked)
            else:
                self.observer.fleet(self.columns.tracks, block)
        self._follow()
        numbers: list[int] = block.numbers.tolist()
        states: list[tuple[int, int, bool, int]] = []
        for change in self._changed(block, codes, looked):
            yield from self._step(block, change, numbers[change.at], states)
        if states:
            rows, at, watched, wakes = zip(*states, strict=True)
            self._watched[rows, at] = watched
            self._wakes[rows, at] = wakes
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
            row: [self.columns.number(each) for each in run.subjects if each.element == track.element.name]
            for row, (run, track) in enumerate(zip(self._of, self.columns.tracks, strict=True))
            if run.disturbed
        }
        clients, room = self.columns.room, self._last.shape[1]
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

    def _changed(self, block: Block | FleetBlock, codes: Codes, looked: Truths | None) -> Iterator[Changes]:
        """Of each subject, where it matters, the ticks at which the observation changes or something is due."""
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
        ticks: list[int] = when.tolist()
        seen: list[int] = codes.ravel()[flat].tolist()
        tracks, subjects = (each.tolist() for each in np.divmod(which[bounds[:-1]], len(block.clients)))
        for row, at, (begin, end) in zip(tracks, subjects, itertools.pairwise(bounds), strict=True):
            yield Changes(row, at, ticks[begin:end], seen[begin:end])

    def _step(
        self, block: Block | FleetBlock, changes: Changes, number: int, states: list[tuple[int, int, bool, int]]
    ) -> list[Happened]:
        """Bring one subject's state forward over all ticks of the block; adds whether it has one, and when to look."""
        row, at = changes.row, changes.at
        run, track = self._of[row], self.columns.tracks[row]
        subject = track.subject(block.clients[at])
        state = run.state(subject) or run.new_state(subject)
        happened: list[Happened] = []
        ticks, timing, count = block.ticks, run.timing, len(block.ticks)
        wake: int | None = None
        for code, begin, end in zip(changes.codes, changes.ticks, (*changes.ticks[1:], count), strict=True):
            first = begin
            while first < end:
                one_by_one = run.has_deploys and state.is_open and run.needs_every_tick(subject)
                ran = state.run(ticks, first, first + 1 if one_by_one else end, timing, code)
                wake, happened_at = ran.wake, ran.at
                if ran.what is not None:
                    candidate = self._candidate(block, track, subject, at * count + happened_at)
                    event = run.happened(ticks[happened_at], ran.what, candidate)
                    if event is not None:
                        happened.append(Happened(ticks[happened_at], self._orders[row], event))
                    happened_at += 1
                elif one_by_one:
                    run.stays(ticks[first], self._candidate(block, track, subject, at * count + first))
                first = happened_at
        idle = state.idle_at(ticks[-1])
        if idle:
            run.drop_state(subject)
        states.append((row, number, not idle, _NEVER if wake is None else wake))
        return happened

    def _candidate(self, block: Block | FleetBlock, track: Track, subject: Subject, point: int) -> Candidate:
        return Candidate(subject, block.variables(track, point), in_scope=True, near=True)


class Blocks:
    """All rules in columns."""

    def __init__(self, context: Context, floor: Callable[[], int | None], observer: Observer | None = None) -> None:
        """`floor`: windows do not reach back to this time or beyond; nanoseconds."""
        self._observer = observer
        self._context = context
        self._floor = floor
        self._depths: list[list[RuleGroup | PairGroup]] = []
        """First the groups whose rules look at no episodes of others, then those that look at episodes of these, …"""
        self._groups: list[RuleGroup | PairGroup] = []
        self._ahead: list[Happened] = []
        """What happened at ticks that others still wait for."""
        self._on_sample: dict[str, RuleGroup] = {}
        self.with_samples: Mapping[str, Sequence[RuleRun]] = {}
        """By stream, the rules that are evaluated with its samples."""
        self.hurries = False
        """Whether there are groups for `run_ahead`."""
        self.names: frozenset[str] = frozenset()
        """The rules that are evaluated here."""

    def set_rules(
        self, runs: Mapping[str, RuleRun], paused: Collection[str], thinning: Callable[[RuleRun], int]
    ) -> None:
        """These rules are evaluated from now on; `thinning`: one in this number of a rule's evaluations takes place."""
        orders = {name: order for order, name in enumerate(runs)}
        depths: dict[str, int] = {}
        together: dict[tuple[int, type[Group | FleetGroup], int, int], list[RuleRun]] = {}
        by_stream: dict[str, list[RuleRun]] = {}
        pairs: list[tuple[int, RuleRun, int]] = []
        for run in runs.values():
            rule, every = run.rule, run.rule.every_ns
            if rule.name in paused or not rule.enabled or run.alone or not fit_signals(rule, self._context.tables):
                continue
            depth = self._depth(rule, depths)
            if depth is None:
                continue
            if every is None:
                if rule.on_sample is not None and fits(rule) and not depth:
                    by_stream.setdefault(rule.on_sample, []).append(run)
                continue
            if fits_pairs(rule, self._context):
                pairs.append((depth, run, every))
            elif fits(rule) or fits_fleet(rule):
                columns = Group if fits(rule) else FleetGroup
                together.setdefault((depth, columns, every, every * thinning(run)), []).append(run)
            else:
                continue
            depths[rule.name] = depth
        self._context.tables.forget_users()
        self._depths = [[] for _ in range(max(depths.values(), default=-1) + 1)]
        for (depth, columns, every, period), chosen in together.items():
            self._depths[depth].append(RuleGroup(chosen, orders, self._context, every, period, columns))
        for depth, run, every in pairs:
            period = every * thinning(run)
            self._depths[depth].append(PairGroup(run, orders[run.rule.name], self._context, every, period))
        self._groups = [group for groups in self._depths for group in groups]
        self.hurries = any(not group.may_wait for groups in self._depths[:1] for group in groups)
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

    def _depth(self, rule: CompiledRule, depths: Mapping[str, int]) -> int | None:
        """How far the rule is above those that look at no other; None: one that it looks at is not evaluated here."""
        named = {signal.rule for signal in signals_of(rule) if signal.rule is not None}
        evaluated = {each for each in named if self._context.starts.is_evaluated(episode_stream(each))}
        if not evaluated <= depths.keys():
            return None
        return 1 + max((depths[each] for each in evaluated), default=0) if named else 0

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
        """Evaluate the groups at this tick later. Returns whether enough points wait to evaluate them now."""
        clients = len(self._context.clients)
        full = False
        ahead = self._depths[0] if self._depths else ()
        for group in groups:
            group.waiting.append(time)
            full = full or len(group.waiting) * max(clients, 1) * group.width > _POINTS * 10
            full = full or not (group.may_wait or group in ahead)
        return full

    @property
    def waiting(self) -> bool:
        """Whether there are ticks that are not evaluated yet."""
        return bool(self._ahead) or any(group.waiting for group in self._groups)

    @property
    def since(self) -> int:
        """The first tick that is not evaluated yet; there is one."""
        first = [group.waiting[0] for group in self._groups if group.waiting]
        return min([*first, *(each.time for each in self._ahead[:1])])

    def run_ahead(self, stopwatch: Callable[[], int]) -> None:
        """Evaluate the groups that take one tick at a time, while the others wait. `run` returns their events."""
        clients = [*self._context.clients]
        for group in self._depths[0]:
            if group.waiting and not group.may_wait:
                ticks, group.waiting = group.waiting, []
                self._ahead += self._noted(
                    _timed(group, ticks, stopwatch, group.evaluate(ticks, clients, self._floor()))
                )

    def run(self, stopwatch: Callable[[], int]) -> list[Happened]:
        """Evaluate all ticks that wait; what happened, in order."""
        happened, self._ahead = self._ahead, []
        clients = [*self._context.clients]
        for groups in self._depths:
            found: list[Happened] = []
            for group in groups:
                if group.waiting:
                    ticks, group.waiting = group.waiting, []
                    found += _timed(group, ticks, stopwatch, group.evaluate(ticks, clients, self._floor()))
            happened += self._noted(found)
        happened.sort(key=_place)
        return happened

    def _noted(self, happened: list[Happened]) -> list[Happened]:
        """The same, in order, once rules that look at episodes of others can see it."""
        happened.sort(key=_place)
        if self._context.starts.needed:
            for each in happened:
                self._context.starts.note(each.event)
        return happened

    def run_with_samples(
        self, stream: str, time: int, only: Mapping[str, Only], stopwatch: Callable[[], int]
    ) -> list[Happened]:
        """Evaluate the rules that are evaluated with the samples of a stream, by rule for these subjects."""
        group = self._on_sample[stream]
        present = sorted({client for each in only.values() for client in each.present(self._context.clients)})
        return self._noted(_timed(group, (time,), stopwatch, group.evaluate((time,), present, self._floor(), only)))


def _place(happened: Happened) -> tuple[int, int, str]:
    return happened.time, happened.order, happened.event.subject


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
