"""Rules about clients or the fleet that are due at the same ticks: applies their observations to episodes."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.fleets import FleetBlock, FleetGroup
from detector.engine.columns.group import ClientGroup
from detector.engine.columns.table import Integers, Truths
from detector.engine.columns.verdicts import Codes
from detector.engine.episodes.episodes import NO_WAKE, TRUE, UNSEEN, UNTIL, UNTIL_UNSURE
from detector.engine.episodes.events import OrderedEvent
from detector.engine.episodes.subjects import Subject
from detector.engine.evaluation.observing import Observer
from detector.engine.evaluation.rule import RuleRun
from detector.engine.scoping.scopes import Candidate
from detector.engine.timing.schedule import SubjectFilter
from wayside.rules import ClientSubject

_NOTHING, _START, _END, _UNSURE_END = range(4)
_EFFECTS = np.zeros(256, np.uint8)
"""By observation, its effect on a rule without `for`, `cooldown` and deploy actions."""
_EFFECTS[TRUE] = _START
_EFFECTS[UNTIL_UNSURE : UNTIL_UNSURE + 4] = _UNSURE_END
_EFFECTS[UNTIL:16] = _END


Changes = tuple[list[int], list[int]]
"""Ticks of a block at which a subject must be evaluated, and its observations there."""


class RuleGroup:
    """The rules that are due at the same ticks, and the last observation of each subject."""

    def __init__(
        self,
        runs: Sequence[RuleRun],
        orders: Mapping[str, int],
        context: Context,
        every: int,
        period: int,
        columns: type[ClientGroup | FleetGroup] = ClientGroup,
    ) -> None:
        """`every` is the period of the rules, `period` the one at which they are evaluated: longer if evaluations are
        thinned."""
        self.every = every
        self.period = period
        self.runs = runs
        self.waiting: list[int] = []
        """Queued ticks."""
        elements = [(run, element) for run in runs for element in run.rule.elements]
        self.columns = columns(
            [
                Track(run.rule, each, run.counters, run.read, row, run.earlier)
                for row, (run, each) in enumerate(elements)
            ],
            context,
        )
        self.observer: Observer | None = None
        self.may_wait = True
        """Whether several ticks can be evaluated together."""
        self.width = len(self.columns.tracks)
        """Number of columns per client."""
        self._of = [run for run in runs for _ in run.rule.elements]
        """The rule of each track."""
        self._budgeted = [run for run in runs if run.rule.maximum_per_hour is not None]
        self._measures = any(signal.episode for run in runs for signal in run.rule.derived)
        """Whether some rule has statistics of its episodes."""
        self._deploying = [(row, run) for row, run in enumerate(self._of) if run.rule.deploys]
        self._timed = [bool(run.rule.deploys or run.timing.hold or run.timing.cooldown) for run in self._of]
        """The tracks for which it matters how long an observation stays the same."""
        self._plain = [isinstance(run.rule.subject, ClientSubject) and not run.rule.has_actions for run in self._of]
        """Rules whose events contain only signals, and that render nothing."""
        self._orders = [orders[run.rule.name] for run in self._of]
        self._context = context
        self._version = -1
        self._last: Codes = np.zeros((0, 0), np.uint8)
        self._wakes: Integers = np.zeros((0, 0), np.int64)
        self._watched: Truths = np.zeros((0, 0), bool)
        """Which subjects have a state. This array and the next ones have a row per track and a column per client."""

    def evaluate(
        self,
        ticks: Sequence[int],
        clients: Sequence[str],
        floor: int | None,
        only: Mapping[str, SubjectFilter] | None = None,
    ) -> list[OrderedEvent]:
        """Evaluate these ticks; returns what happened. `only`: by rule, the subjects to evaluate; the others are
        skipped."""
        happened: list[OrderedEvent] = []
        if not clients and self.columns.needs_clients:
            return happened
        selected = None if only is None else self._selected(clients, only)
        if only is not None:
            for run in self.runs:
                run.touched = []
        block, codes = self.columns.evaluate(ticks, clients, floor, selected)
        if self.observer is not None:
            if isinstance(block, Block):
                self.observer.clients(self.columns.tracks, block, codes, selected)
            else:
                self.observer.fleet(self.columns.tracks, block)
        self._follow()
        numbers: list[int] = block.numbers.tolist()
        states: list[tuple[int, int, bool, int]] = []
        for row, at, changes in self._changed(block, codes, selected):
            states.append((row, numbers[at], *self._step(block, row, at, changes, happened)))
            if only is not None:
                self._of[row].touched.append(self.columns.tracks[row].subject(block.clients[at]))
        if self._measures and isinstance(block, Block):
            self._measure(block)
        if states:
            rows, places, watched, wakes = zip(*states, strict=True)
            self._watched[rows, places] = watched
            self._wakes[rows, places] = wakes
        last = ticks[-1]
        for run in self._budgeted:
            run.budget.expire(last)
        return happened

    def _selected(self, clients: Sequence[str], only: Mapping[str, SubjectFilter]) -> Truths | None:
        """Which clients each track evaluates; None: all."""
        chosen = [only.get(run.rule.name) for run in self._of]
        first = chosen[0]
        if (
            first is not None
            and not first.subjects
            and first.clients.issuperset(clients)
            and all(each is first for each in chosen)
        ):
            return None
        selected = np.zeros((len(chosen), len(clients)), bool)
        for row, (these, track) in enumerate(zip(chosen, self.columns.tracks, strict=True)):
            if these is not None:
                selected[row] = [these.contains(track.subject(client)) for client in clients]
        return selected

    def _follow(self) -> None:
        """Add new clients, and the states that changed elsewhere."""
        tables = self._context.tables
        if self._version != tables.version:
            self._version = tables.version
            nobody = (len(self._of), 0)
            self._last, self._wakes = np.zeros(nobody, np.uint8), np.zeros(nobody, np.int64)
            self._watched = np.zeros(nobody, bool)
            for run in self.runs:
                run.disturbed = True
        disturbed = [row for row, run in enumerate(self._of) if run.disturbed]
        # Before the arrays grow: this can assign numbers, because a restored subject may have no sample yet.
        watched = {row: self._watched_numbers(row) for row in disturbed}
        clients, room = self.columns.room, self._last.shape[1]
        if clients > room:
            more = (len(self._of), max(clients, 2 * room) - room)
            self._last = np.concatenate((self._last, np.full(more, UNSEEN, np.uint8)), axis=1)
            self._wakes = np.concatenate((self._wakes, np.full(more, NO_WAKE)), axis=1)
            self._watched = np.concatenate((self._watched, np.zeros(more, bool)), axis=1)
        for row, numbers in watched.items():
            self._last[row] = UNSEEN
            self._watched[row] = False
            self._watched[row, numbers] = True
            self._of[row].disturbed = False

    def _watched_numbers(self, row: int) -> list[int]:
        """The numbers of a track's subjects that have a state."""
        element = self.columns.tracks[row].element.name
        return [self.columns.number(each) for each in self._of[row].states if each.element == element]

    def _changed(
        self, block: Block | FleetBlock, codes: Codes, selected: Truths | None
    ) -> Iterator[tuple[int, int, Changes]]:
        """Each subject that may change (a track and a client of the block), with its observations that may matter."""
        numbers, count = block.numbers, len(block.ticks)
        before, wakes, watched = self._last[:, numbers], self._wakes[:, numbers], self._watched[:, numbers]
        changed = np.empty(codes.shape, bool)
        np.not_equal(codes[:, :, 0], before, out=changed[:, :, 0])
        np.not_equal(codes[:, :, 1:], codes[:, :, :-1], out=changed[:, :, 1:])
        changed[:, :, 0] |= wakes <= block.ticks[-1]
        for row, run in self._deploying:
            if run.open_episodes:
                track = self.columns.tracks[row]
                for at in np.flatnonzero(watched[row]).tolist():
                    if run.needs_every_tick(track.subject(block.clients[at])):
                        changed[row, at] = True
        if selected is None:
            self._last[:, numbers] = codes[:, :, -1]
        else:
            changed &= selected[:, :, None]
            self._last[:, numbers] = np.where(selected, codes[:, :, -1], before)
        if not changed.any():
            return
        changed &= (watched | (codes & 3 == TRUE).any(axis=2))[:, :, None]
        if block.present is not None:
            changed &= block.present
        flat = np.flatnonzero(changed)
        if not len(flat):
            return
        which, when = np.divmod(flat, count)
        seen = codes.ravel()[flat]
        if count > 1 and not all(self._timed):
            alert = watched & ((wakes != NO_WAKE) | (before == UNSEEN))
            timed = np.array(self._timed)[which // len(block.clients)]
            kept = _with_effect(which, _EFFECTS[seen], timed, watched.ravel()[which], alert.ravel()[which])
            which, when, seen = which[kept], when[kept], seen[kept]
            if not len(which):
                return
        bounds = [0, *(np.flatnonzero(np.diff(which)) + 1).tolist(), len(which)]
        ticks, observations = when.tolist(), seen.tolist()
        tracks, subjects = (each.tolist() for each in np.divmod(which[bounds[:-1]], len(block.clients)))
        for row, at, (begin, end) in zip(tracks, subjects, itertools.pairwise(bounds), strict=True):
            yield row, at, (ticks[begin:end], observations[begin:end])

    def _step(
        self, block: Block | FleetBlock, row: int, at: int, changes: Changes, happened: list[OrderedEvent]
    ) -> tuple[bool, int]:
        """Advance one subject's state over all ticks of the block, and note what happened.

        Returns whether it keeps a state, and when to evaluate it again.
        """
        run, track = self._of[row], self.columns.tracks[row]
        subject = track.subject(block.clients[at])
        state = run.state(subject)
        ticks, timing, count = block.ticks, run.timing, len(block.ticks)
        begins, codes = changes
        deploys, timed = run.rule.deploys, self._timed[row]
        wake: int | None = None
        for code, begin, end in zip(codes, begins, (*begins[1:], count), strict=True):
            first = begin
            if not timed and (code == TRUE or code >= UNTIL):
                end = begin + 1  # noqa: PLW2901  the later ticks have no effect
            while first < end:
                one_by_one = bool(deploys) and state.is_open and run.needs_every_tick(subject)
                happened_at, what, wake = state.run(ticks, first, first + 1 if one_by_one else end, timing, code)
                if what is not None:
                    if self._measures:
                        self._measure_until(block, row, at, subject, happened_at)
                    candidate = self._candidate(block, track, subject, at * count + happened_at)
                    event = run.happened(ticks[happened_at], what, candidate)
                    if event is not None:
                        happened.append(OrderedEvent(ticks[happened_at], self._orders[row], event))
                    happened_at += 1
                elif one_by_one:
                    self._measure_until(block, row, at, subject, first)
                    run.stays(ticks[first], self._candidate(block, track, subject, at * count + first))
                first = happened_at
        idle = state.idle_at(ticks[-1])
        if idle:
            del run.states[subject]
        return not idle, NO_WAKE if wake is None else wake

    def _candidate(self, block: Block | FleetBlock, track: Track, subject: Subject, point: int) -> Candidate:
        if not isinstance(block, Block):
            return Candidate(subject, block.variables(track, point), True, True)
        seen = block.values(track, point) if self._plain[track.row] else block.variables(track, point)
        if not self._measures:
            return Candidate(subject, seen, True, True)
        return Candidate(subject, seen, in_scope=True, near=True, measured=block.measured_at(track.row, point))

    def _measure(self, block: Block) -> None:
        """Add the rest of the block to the statistics of the open episodes."""
        at = {client: place for place, client in enumerate(block.clients)}
        for row, (run, track) in enumerate(zip(self._of, self.columns.tracks, strict=True)):
            for subject in run.measured:
                if subject.element == track.element.name and subject.clients[0] in at:
                    self._measure_until(block, row, at[subject.clients[0]], subject, len(block.ticks))

    def _measure_until(self, block: Block | FleetBlock, row: int, at: int, subject: Subject, end: int) -> None:
        """Add the block's ticks before `end` to the statistics of the subject's episode, if it has one."""
        run = self._of[row]
        statistics = run.statistics(subject)
        if statistics is None or not isinstance(block, Block):
            return
        selected = block.points(row)
        for tick in range(bisect_right(block.ticks, statistics.until), end):
            point = at * len(block.ticks) + tick
            if selected is None or selected[point]:
                statistics.add(block.ticks[tick], block.measured_at(row, point), run.counters)


def _with_effect(subjects: Integers, effects: Codes, timed: Truths, watched: Truths, alert: Truths) -> Integers:
    """The indices of the changes that may have an effect, of all changes by subject and tick; shapes (changes,).

    `timed`: all changes of the rule matter. `watched`: the subject has a state. `alert`: its first change matters.
    """
    before = _shifted(subjects, effects, np.where(alert, _UNSURE_END, _NOTHING))
    kept = np.flatnonzero(timed | (effects != _NOTHING) | (before == _UNSURE_END))
    # Of starts (or ends) in a row only the first has an effect. A subject without a state needs no end.
    effects = effects[kept]
    before = _shifted(subjects[kept], effects, np.where(watched[kept], _NOTHING, _END))
    repeated = (before == effects) & ((effects == _START) | (effects == _END))
    found: Integers = kept[timed[kept] | ~repeated]
    return found


def _shifted(subjects: Integers, effects: Codes, first: NDArray[Any]) -> NDArray[Any]:
    """The previous effect of the same subject, for each effect; `first` for the first of a subject."""
    begins = np.concatenate(([True], subjects[1:] != subjects[:-1]))
    return np.where(begins, first, np.roll(effects, 1))
