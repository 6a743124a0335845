"""Records the trace of a replay: observes the engine's columns, and the rules that are not in columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.block import Block, Track
from detector.engine.columns.fleets import FleetBlock
from detector.engine.columns.pairs import PairBlock
from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Codes
from detector.engine.engine import Engine
from detector.engine.episodes.episodes import OUTSIDE
from detector.engine.episodes.subjects import FLEET, Subject
from detector.results.changes import Changes
from detector.results.joining import EvaluatedBlock, JoinedBlock, joined_blocks
from detector.results.pairing import PairLog, PathLog
from detector.results.reasons import of_variables, why_unknown
from detector.results.recorded_values import RecordedValues
from detector.results.series import (
    AWAY,
    UNKNOWN,
    Bytes,
    Doubles,
    Integers,
    Series,
    SeriesKind,
    Steps,
    SubjectTrace,
    Trace,
    Wanted,
    codes_of,
    paths_of,
    steps_of,
)
from wayside.expressions.columns.values import Tag
from wayside.names import parse_subject
from wayside.rules import CompiledRule, PairSubject

_POINTS = 20_000
"""Number of points (client and tick) that are recorded together."""


class _Plan(NamedTuple):
    """The values that are recorded from the blocks of one group."""

    tracks: Sequence[Track]
    signals: Sequence[tuple[int, Track, str, Changes]]
    """The index of each signal in the block, a track that uses it with its name there, and its changes."""
    conditions: Sequence[tuple[int, Track, str, Changes]]
    """The row of a track, the track, the field and its changes."""
    seen: set[int]
    """The clients of the previous block."""
    waiting: list[EvaluatedBlock]
    """Small blocks, which are recorded together: live and beside rules about pairs, blocks have few ticks."""


class Tracer:
    """The engine's observer in a replay; returns the trace at the end."""

    def __init__(self, subjects: Mapping[str, Set[str] | None] | None = None, *, paths: bool = True) -> None:
        """`subjects`: those to trace by rule, None: all; `paths`: record the clients' places."""
        self._subjects = subjects
        chosen = {rule: texts for rule, texts in (subjects or {}).items() if texts is not None}
        self._clients_by_rule = {rule: _clients_of(texts) for rule, texts in chosen.items()}
        self._traced: dict[str, set[int]] = {rule: set() for rule in chosen}
        """The numbers of the traced clients, for each rule with a selection."""
        self._everybody = subjects is None or len(chosen) < len(subjects)
        self._with_paths = paths
        self.engine: Engine | None = None  # of the replay, for its counts
        self._plans: dict[int, _Plan] = {}
        self._signals: dict[str, Changes] = {}
        self._aliases: dict[tuple[str, str | None, str], dict[str, Changes]] = {}
        """By rule, element and signal: the place of its values; equal signals of several rules are stored once."""
        self._conditions: dict[tuple[str, str | None, str], Changes] = {}
        self._reasons: dict[tuple[str, str | None, str], dict[tuple[int, int], str]] = {}
        """For conditions, by client and time, why they are unknown."""
        self._names: list[str] = []
        self._numbers: dict[str, int] = {}
        self._texts: dict[str, int] = {}
        self._odd: set[tuple[str, str | None, str]] = set()
        """Signals with lists or maps: these appear only in events."""
        self._clients: tuple[Sequence[str], Integers] = ((), np.zeros(0, np.int64))
        self._pairs: dict[tuple[str, str], PairLog] = {}
        """By rule and its digest."""
        self._paths = PathLog()
        self._recorded: dict[str, RecordedValues] = {}
        self._begin: int | None = None
        self._end = 0

    # Input

    def attend(self, engine: Engine) -> None:
        """Rules were set: those that are not in columns are observed separately."""
        self.engine = engine
        for name, run in engine.rules.items():
            if name not in engine.in_columns:
                run.on_evaluated = self.recorded(run.rule).record

    def recorded(self, rule: CompiledRule) -> RecordedValues:
        """The record of a rule that is not in columns."""
        return self._recorded.setdefault(rule.name, RecordedValues(rule))

    def clients(self, tracks: Sequence[Track], block: Block, codes: Codes, selected: Truths | None) -> None:
        """Record the changes in a block of rules about clients."""
        self._time(block.ticks[0], block.ticks[-1])
        plan = self._plans.get(id(tracks))
        if plan is None:
            self.flush()  # for rules that were evaluated differently until now
            plan = self._plans[id(tracks)] = self._plan(tracks)
        if not plan.conditions:
            return
        numbers = self._numbers_of(block.clients)
        if selected is None and not _has_texts(plan, block):  # codes of texts may not last
            plan.waiting.append(EvaluatedBlock(block, codes, numbers))
            if sum(len(each.block.ticks) for each in plan.waiting) * len(numbers) >= _POINTS:
                self._flush_plan(plan)
            return
        self._flush_plan(plan)
        self._note(plan, JoinedBlock([block]), codes, numbers, selected)

    def flush(self) -> None:
        """Record all queued blocks. After this call, the trace no longer needs the engine."""
        for plan in self._plans.values():
            self._flush_plan(plan)

    def _flush_plan(self, plan: _Plan) -> None:
        """Record the queued blocks of a plan."""
        for joined in joined_blocks(plan.waiting):
            self._note(plan, joined.block, joined.codes, joined.numbers, None)
        plan.waiting.clear()

    def _note(self, plan: _Plan, block: JoinedBlock, codes: Codes, numbers: Integers, selected: Truths | None) -> None:
        everybody = selected is None
        at_all = self._rows(numbers, None if selected is None else np.asarray(selected.any(axis=0)))
        for at, track, name, changes in plan.signals:
            self._signal(block, track, name, numbers, changes, at, at_all)
        for row, track, field, changes in plan.conditions:
            chosen = self._rows(numbers, None if selected is None else selected[row])
            self._condition(block, codes, row, track, field, numbers, changes, chosen)
        if everybody:
            gone = plan.seen.difference(numbers.tolist())
            if gone:
                self._record_lost(plan, np.array(sorted(gone), np.int64), block.times[:1])
            plan.seen.clear()
            plan.seen.update(numbers.tolist())

    def _rows(self, numbers: Integers, selected: Truths | None) -> slice | Truths:
        """The traced clients of a block, among those that the rule evaluates."""
        if self._everybody:
            return slice(None) if selected is None else selected
        traced = np.isin(numbers, [*set().union(*self._traced.values())])
        return traced if selected is None else traced & selected

    def fleet(self, tracks: Sequence[Track], block: FleetBlock) -> None:
        """Record the changes in a block of rules about the fleet: the number of members, and conditions."""
        self._time(block.ticks[0], block.ticks[-1])
        numbers = np.array([self._number(FLEET)], np.int64)
        for track, members, verdicts in zip(tracks, block.members, block.verdicts, strict=True):
            if not self.traces(track.rule.name):
                continue
            key = _key(track, "count")
            changes = self._signals.setdefault("/".join(key), Changes())
            self._aliases.setdefault((track.rule.name, track.element.name, "count"), {})["/".join(key)] = changes
            count = members.sum(axis=0, dtype=float).reshape(1, -1)
            changes.add(numbers, block.times, count, np.full(count.shape, Tag.NUMBER, np.uint8), None)
            for field, verdict in verdicts.items():
                name = track.rule.name, track.element.name, field
                reasons = self._reasons.setdefault(name, {})
                codes = codes_of(verdict.true, verdict.false).astype(float).reshape(1, -1)
                conditions = self._conditions.setdefault(name, Changes())
                found = conditions.add(numbers, block.times, codes, np.zeros(codes.shape, np.uint8), None)
                expression = track.rule.when if field == "when" else track.rule.until
                for tick in found.ticks[found.values == UNKNOWN].tolist():
                    why = of_variables(track.rule, expression, block.variables(track, tick))
                    reasons[int(numbers[0]), block.ticks[tick]] = why

    def pairs(self, track: Track, these: PairBlock) -> None:
        """Record the values of a rule about pairs at a tick."""
        time = these.block.ticks[0]
        self._time(time, time)
        if not self._with_paths and not self.traces(track.rule.name):
            return
        numbers = self._numbers_of(these.block.clients)
        if self.traces(track.rule.name):
            log = self._pairs.setdefault((track.rule.name, track.rule.digest), PairLog(track))
            log.add(time, these, numbers)
        if self._with_paths:
            assert isinstance(track.rule.subject, PairSubject)  # noqa: S101  the rule is about pairs
            self._paths.add(track.rule.name, track.rule.subject.position.geographic, time, these, numbers)

    def traces(self, rule: str) -> bool:
        """Whether the rule is traced."""
        return self._subjects is None or rule in self._subjects

    # Output

    def trace(self, wanted: Wanted = lambda rule, subject: True) -> Trace:
        """The trace of the wanted subjects."""
        self.flush()
        found: dict[tuple[str, str], SubjectTrace] = {}
        self._of_clients(found, wanted)
        for (name, _), log in self._pairs.items():
            for pair in log.subjects(name, self._names, wanted):
                found[name, pair.subject] = pair
        for name, recorded in self._recorded.items():
            for each in recorded.subjects():
                if not wanted(name, each.subject):
                    continue
                found.setdefault((name, each.subject), each)
                self._time(*recorded.span)
        subjects = [found[key] for key in sorted(found)]
        paths, geographic = self._paths.paths(self._names), self._paths.geographic
        if not paths and self._with_paths:
            paths, geographic = paths_of(subjects)
        return Trace(subjects, paths, geographic, self._begin or 0, self._end)

    def _of_clients(self, found: dict[tuple[str, str], SubjectTrace], wanted: Wanted) -> None:
        subjects: dict[tuple[str, str | None, int], SubjectTrace] = {}
        for (rule, element, field), changes in self._conditions.items():
            reasons = self._reasons[rule, element, field]
            for client, times, values, _ in changes.by_client(self._traced.get(rule)):
                clients = () if self._names[client] == FLEET else (self._names[client],)
                text = Subject(clients, element).text
                if wanted(rule, text):
                    subject = found.setdefault((rule, text), SubjectTrace(rule, text, clients))
                    subject.conditions[field] = _steps(times, values.astype(np.uint8), reasons, client)
                    subjects[rule, element, client] = subject
        texts = tuple(self._texts)
        for (rule, element, signal), parts in self._aliases.items():
            if (rule, element, signal) in self._odd:
                continue
            by_client: dict[int, list[Series]] = {}
            for changes in parts.values():
                for client, times, values, tags in changes.by_client(self._traced.get(rule)):
                    if (rule, element, client) in subjects:
                        by_client.setdefault(client, []).append(series_of(times, values, tags, texts))
            for client, series in by_client.items():
                subjects[rule, element, client].signals[signal] = _joined(series)

    # Blocks

    def _plan(self, tracks: Sequence[Track]) -> _Plan:
        owners: dict[int, tuple[Track, str]] = {}
        wanted = [track for track in tracks if self.traces(track.rule.name)]
        for track in wanted:
            for name, at in track.signals.items():
                if at not in owners or _key(track, name) < _key(*owners[at]):
                    owners[at] = track, name
        signals = []
        for at, (track, name) in owners.items():
            changes = self._signals.setdefault("/".join(_key(track, name)), Changes())
            signals.append((at, track, name, changes))
            for other in wanted:
                for alias, place in other.signals.items():
                    if place == at:
                        parts = self._aliases.setdefault((other.rule.name, other.element.name, alias), {})
                        parts["/".join(_key(track, name))] = changes
        conditions = []
        for row, track in enumerate(tracks):
            for field, expression in (("when", track.rule.when), ("until", track.rule.until)):
                if expression is not None and self.traces(track.rule.name):
                    key = (track.rule.name, track.element.name, field)
                    self._reasons.setdefault(key, {})
                    conditions.append((row, track, field, self._conditions.setdefault(key, Changes())))
        return _Plan(tracks, signals, conditions, set(), [])

    def _signal(
        self,
        block: JoinedBlock,
        track: Track,
        name: str,
        numbers: Integers,
        changes: Changes,
        at: int,
        chosen: slice | NDArray[np.bool_],
    ) -> None:
        column, shape = block.signals[at], block.shape
        values = column.values.reshape(shape)[chosen]
        tags = np.full(shape, Tag.NUMBER, np.uint8) if column.tags is None else column.tags.reshape(shape)
        tags = tags[chosen]
        present = None if block.present is None else block.present[chosen]
        if not len(values):
            return
        if (tags == Tag.OTHER).any():
            self._odd.update(key for key, parts in self._aliases.items() if changes in parts.values())
        found = changes.add(numbers[chosen], block.times, values, tags, present)
        texts = tags[found.rows, found.ticks] == Tag.TEXT
        if texts.any():
            places = np.arange(shape[0])[chosen]
            for place in np.flatnonzero(texts).tolist():
                point = int(places[found.rows[place]]) * shape[1] + int(found.ticks[place])
                text = str(block.at(point)[0].values(track, block.at(point)[1])[name])
                found.values[place] = self._texts.setdefault(text, len(self._texts))

    def _condition(
        self,
        block: JoinedBlock,
        codes: Codes,
        row: int,
        track: Track,
        field: str,
        numbers: Integers,
        changes: Changes,
        chosen: slice | NDArray[np.bool_],
    ) -> None:
        shape = block.shape
        true, false = (each[row].reshape(shape)[chosen] for each in block.verdicts[field])
        states = codes_of(true, false).astype(float)
        states[codes[row][chosen] & OUTSIDE == OUTSIDE] = AWAY
        if not len(states):
            return
        present = None if block.present is None else block.present[chosen]
        tags = np.zeros(states.shape, np.uint8)
        found = changes.add(numbers[chosen], block.times, states, tags, present)
        expression = track.rule.when if field == "when" else track.rule.until
        reasons = self._reasons[track.rule.name, track.element.name, field]
        places = np.arange(shape[0])[chosen]
        for place in np.flatnonzero(found.values == UNKNOWN).tolist():
            at, tick = int(places[found.rows[place]]), int(found.ticks[place])
            why = why_unknown(*block.at(at * shape[1] + tick), track, expression)
            reasons[int(numbers[at]), block.ticks[tick]] = why

    def _record_lost(self, plan: _Plan, gone: Integers, times: Integers) -> None:
        """Record that clients were lost."""
        shape = (len(gone), 1)
        for _, _, _, changes in plan.signals:
            changes.add(gone, times, np.zeros(shape), np.full(shape, Tag.ABSENT, np.uint8), None)
        for _, _, _, changes in plan.conditions:
            changes.add(gone, times, np.full(shape, float(AWAY)), np.zeros(shape, np.uint8), None)

    def _numbers_of(self, clients: Sequence[str]) -> Integers:
        known, numbers = self._clients
        if known is not clients and known != clients:
            numbers = np.array([self._number(client) for client in clients], np.int64)
            self._clients = clients, numbers
        return numbers

    def _number(self, client: str) -> int:
        number = self._numbers.get(client)
        if number is None:
            number = self._numbers[client] = len(self._names)
            self._names.append(client)
            for rule, clients in self._clients_by_rule.items():
                if client in clients:
                    self._traced[rule].add(number)
        return number

    def _time(self, first: int, last: int) -> None:
        self._begin = first if self._begin is None else min(self._begin, first)
        self._end = max(self._end, last)


def _clients_of(subjects: Set[str]) -> Set[str]:
    """The clients of single-client subjects; FLEET for the fleet."""
    return {clients[0] if clients else FLEET for clients, _ in map(parse_subject, subjects) if len(clients) < 2}


def _has_texts(plan: _Plan, block: Block) -> bool:
    tags = (block.signals[at].tags for at, _, _, _ in plan.signals)
    return any(each is not None and bool((each == Tag.TEXT).any()) for each in tags)


def _key(track: Track, name: str) -> tuple[str, str, str]:
    return track.rule.name, track.element.name or "", name


def _steps(times: Integers, codes: Bytes, reasons: Mapping[tuple[int, int], str], client: int) -> Steps:
    kept = np.ones(len(codes), bool)
    kept[1:] = codes[1:] != codes[:-1]
    return steps_of(times[kept], codes[kept], reasons, client)


def series_of(times: Integers, values: Doubles, tags: Bytes, texts: Sequence[str]) -> Series:
    """The series of one signal of one subject; `tags` are those of its values, where texts are indices into `texts`."""
    if (tags == Tag.NUMBER).all():
        return Series(times, values)
    known = (tags != Tag.ABSENT) & (tags != Tag.UNREACHABLE)
    kinds = {Tag.BOOLEAN: SeriesKind.BOOLEAN, Tag.TEXT: SeriesKind.TEXT}
    kind = next((kinds[tag] for tag in kinds if (tags == tag).any()), SeriesKind.NUMBER)
    return Series(times, np.where(known, values, np.nan), kind, texts if kind is SeriesKind.TEXT else ())


def _joined(parts: Sequence[Series]) -> Series:
    """The same signal under several consecutive plans."""
    if len(parts) == 1:
        return parts[0]
    times = np.concatenate([part.times for part in parts])
    order = np.argsort(times, kind="stable")
    values = np.concatenate([part.values for part in parts])
    return Series(times[order], values[order], parts[0].kind, parts[0].texts)
