"""The values of rules about pairs, tick by tick, and the clients' places."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.block import Track
from detector.engine.columns.pairs import PairBlock
from detector.engine.episodes.episodes import OUTSIDE
from detector.engine.episodes.subjects import Subject
from detector.results.reasons import of_stream
from detector.results.series import (
    AWAY,
    UNKNOWN,
    Bytes,
    ClientPath,
    Doubles,
    Integers,
    Series,
    SeriesKind,
    SubjectTrace,
    Wanted,
    codes_of,
    steps_of,
)
from wayside.expressions.columns.values import Column, Tag
from wayside.rules import PairSubject

_SHIFT = 32
_ROLES = ("a", "b")


class PairLog:
    """The values of one rule for its pairs."""

    def __init__(self, track: Track) -> None:
        self._track = track
        self._ticks: list[int] = []
        self._keys: list[Integers] = []
        self._codes: dict[str, list[Bytes]] = {"when": []}
        if track.rule.until is not None:
            self._codes["until"] = []
        self._values: dict[str, list[Doubles]] = {"distance": []}
        self._kinds: dict[str, SeriesKind] = {}
        self._odd: set[str] = set()
        self._unsure: dict[str, Integers] = {}
        self._reasons: dict[str, dict[tuple[int, int], str]] = {field: {} for field in self._codes}

    def add(self, time: int, these: PairBlock, numbers: Integers) -> None:
        """Record a tick; `numbers` are those of the clients in the block."""
        self._ticks.append(time)
        keys = numbers[these.first] << _SHIFT | numbers[these.second]
        self._keys.append(keys)
        outside = these.codes & OUTSIDE == OUTSIDE
        for field, parts in self._codes.items():
            verdict = these.verdicts[field]
            codes = codes_of(verdict.true, verdict.false)
            codes[outside] = AWAY
            parts.append(codes)
            self._note_unsure(field, time, these, keys, codes)
        self._values["distance"].append(np.where(these.placed, these.distance, np.nan))
        if these.closing is not None and these.closing_known is not None:
            speeds = np.where(these.closing_known, these.closing, np.nan)
            self._values.setdefault("closingSpeed", []).append(speeds)
        for name, own in these.derived.items():
            self._values.setdefault(name, []).append(self._numbers(name, own))
        for name, at in self._track.signals.items():
            column = these.seen.signals[at] if len(these.first) else None
            for role, clients in zip(_ROLES, (these.first, these.second), strict=True):
                values = self._values.setdefault(f"{role}.{name}", [])
                if column is None:
                    values.append(np.zeros(0))
                    continue
                rows = these.at[clients]
                own = Column(column.values[rows], None if column.tags is None else column.tags[rows])
                values.append(self._numbers(f"{role}.{name}", own))

    def _numbers(self, name: str, column: Column) -> Doubles:
        """The values of a signal, NaN if unknown; notes other types than numbers."""
        tags = column.tags
        if tags is None:
            return column.values
        if ((tags == Tag.OTHER) | (tags == Tag.TEXT)).any():
            self._odd.add(name)
        if (tags == Tag.BOOLEAN).any():
            self._kinds[name] = SeriesKind.BOOLEAN
        return np.where((tags == Tag.NUMBER) | (tags == Tag.BOOLEAN), column.values, np.nan)

    def subjects(self, rule: str, names: Sequence[str], wanted: Wanted) -> Iterator[SubjectTrace]:
        """Each evaluated and wanted pair; `names` are the clients', by their numbers."""
        sizes = [len(keys) for keys in self._keys]
        if not sum(sizes):
            return
        keys, ordinals = np.concatenate(self._keys), np.repeat(np.arange(len(sizes)), sizes)
        order = np.argsort(keys, kind="stable")
        keys, ordinals = keys[order], ordinals[order]
        ticks = np.array(self._ticks, np.int64)
        by_field = {field: np.concatenate(parts)[order] for field, parts in self._codes.items()}
        values = {name: np.concatenate(parts)[order] for name, parts in self._values.items() if name not in self._odd}
        bounds = [0, *(np.flatnonzero(np.diff(keys)) + 1).tolist(), len(keys)]
        for begin, end in itertools.pairwise(bounds):
            key, own = int(keys[begin]), slice(begin, end)
            clients = names[key >> _SHIFT], names[key & (1 << _SHIFT) - 1]
            text = Subject(clients, self._track.element.name).text
            if not wanted(rule, text):
                continue
            subject = SubjectTrace(rule, text, clients)
            left = _left(ordinals[own], len(ticks))
            for name, column in values.items():
                kind = self._kinds.get(name, SeriesKind.NUMBER)
                subject.signals[name] = Series(*_changes(ticks, ordinals[own], column[own], left, np.nan), kind)
            for field, evaluated in by_field.items():
                times, codes = _changes(ticks, ordinals[own], evaluated[own].astype(float), left, AWAY)
                subject.conditions[field] = steps_of(times, codes.astype(np.uint8), self._reasons[field], key)
            yield subject

    def _note_unsure(self, field: str, time: int, these: PairBlock, keys: Integers, codes: Bytes) -> None:
        """For pairs whose condition becomes unknown here, note the reason."""
        at = np.flatnonzero(codes == UNKNOWN)
        before = self._unsure.get(field)
        if not len(at) and before is None:
            return
        unsure = keys[at]
        for row in at.tolist() if before is None else at[~np.isin(unsure, before)].tolist():
            self._reasons[field][int(keys[row]), time] = self._why(field, these, row)
        self._unsure[field] = unsure

    def _why(self, field: str, these: PairBlock, row: int) -> str:
        rule = self._track.rule
        assert isinstance(rule.subject, PairSubject)  # noqa: S101  the rule is about pairs
        expression = rule.when if field == "when" else rule.until
        read = set() if expression is None else {path[:2] for path in expression.paths}
        for role, index in zip(_ROLES, (int(these.first[row]), int(these.second[row])), strict=True):
            client = these.block.clients[index]
            if not these.places.known[index]:
                return f"position of {client}: no sample of stream {rule.subject.position.stream}, or an old one"
            point = int(these.at[index])
            values = these.seen.values(self._track, point)
            for signal in rule.signals:
                if (role, signal.name) in read and signal.name not in values:
                    return f"{role}.{signal.name} of {client}: {of_stream(these.seen, signal.stream, point)}"
        for name in sorted({str(path[0]) for path in read} & these.derived.keys()):
            if np.isnan(self._numbers(name, these.derived[name])[row]):
                return f"{name}: no value"
        return "it reads a value that does not exist"


class PathLog:
    """The places of clients, as seen by one of the rules about pairs: the first one."""

    def __init__(self) -> None:
        self.geographic = False
        self._rule: str | None = None
        self._times: list[int] = []
        self._clients: list[Integers] = []
        self._axes: list[Doubles] = []

    def add(self, rule: str, geographic: bool, time: int, these: PairBlock, numbers: Integers) -> None:
        """Record a tick."""
        if self._rule is None:
            self._rule, self.geographic = rule, geographic
        if rule != self._rule:
            return
        known = these.places.known
        self._times.append(time)
        self._clients.append(numbers[known])
        self._axes.append(these.places.axes[:2, known])

    def paths(self, names: Sequence[str]) -> dict[str, ClientPath]:
        """By client, its places; without repeated ones."""
        if not self._times:
            return {}
        clients = np.concatenate(self._clients)
        times = np.repeat(np.array(self._times, np.int64), [len(each) for each in self._clients])
        axes = np.concatenate(self._axes, axis=1)
        order = np.argsort(clients, kind="stable")
        clients, times, axes = clients[order], times[order], axes[:, order]
        moved = np.ones(len(clients), bool)
        moved[1:] = (clients[1:] != clients[:-1]) | (axes[:, 1:] != axes[:, :-1]).any(axis=0)
        clients, times, axes = clients[moved], times[moved], axes[:, moved]
        bounds = [0, *(np.flatnonzero(np.diff(clients)) + 1).tolist(), len(clients)] if len(clients) else [0]
        return {
            names[int(clients[begin])]: ClientPath(times[begin:end], axes[:, begin:end])
            for begin, end in itertools.pairwise(bounds)
        }


def _left(ordinals: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """The indices after which the pair was not evaluated."""
    after = np.flatnonzero(np.diff(ordinals) > 1)
    return np.append(after, len(ordinals) - 1) if ordinals[-1] < count - 1 else after


def _changes(
    ticks: Integers, ordinals: NDArray[np.intp], values: Doubles, left: NDArray[np.intp], away: float
) -> tuple[Integers, Doubles]:
    """Times and values at changes; `away` where the evaluation of the pair ends."""
    kept = np.ones(len(values), bool)
    same = (values[1:] == values[:-1]) | ((values[1:] != values[1:]) & (values[:-1] != values[:-1]))
    kept[1:] = ~same | (np.diff(ordinals) > 1)
    at = np.flatnonzero(kept)
    places = np.concatenate((ordinals[at], ordinals[left] + 1))
    found = np.concatenate((values[at], np.full(len(left), away).astype(values.dtype)))
    order = np.argsort(places, kind="stable")
    return ticks[places[order]], found[order]
