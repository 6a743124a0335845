"""Signals over other signals: expressions over the points of a block, and windows over their earlier values.

`with_derived` computes them for rules that are evaluated one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.client_values import ClientValues
from detector.engine.columns.earlier import EarlierValues, Evaluations
from detector.engine.columns.formulas import Formula, Rows
from detector.engine.columns.table import Integers
from detector.engine.counters import RuleCounters
from detector.engine.scoping.scopes import Candidate, evaluated
from wayside.expressions import UNKNOWN, Path, Reason
from wayside.expressions.columns.lowering import Constant
from wayside.expressions.columns.values import Column, Tag, Texts, column_of, value_at
from wayside.rules import CompiledDerived, CompiledRule


class Derived(NamedTuple):
    """A signal at some evaluations."""

    signal: CompiledDerived
    column: Column
    """For a statistic of the open episode, the values that it aggregates."""


class DerivedColumns:
    """The signals over other signals of one track."""

    def __init__(self, track: Track, leaf: Callable[[Path], Hashable | Constant | None], context: Context) -> None:
        self._track = track
        self._texts = context.tables.texts
        self._formulas = [
            (signal, Formula(signal.name, signal.of, leaf, self._texts))
            for signal in track.rule.derived
            if signal.of is not None
        ]

    def compute(self, rows: Rows, now: Evaluations) -> Iterator[Derived]:
        """Compute each signal at the rows, one per evaluation. Its windows also contain earlier evaluations."""
        track = self._track
        for signal, formula in self._formulas:
            column = formula.column(rows)
            if not signal.episode:
                column = track.earlier.window(signal, track.element.name, now, column, self._texts, track.counters)
            yield Derived(signal, column)


class ClientDerived:
    """The signals over other signals of rules about clients."""

    def __init__(self, context: Context, tracks: list[Track], first: int) -> None:
        """Their indices among the signals of a block start at `first`; this call adds them to the tracks."""
        self._context = context
        for track in tracks:
            for signal in track.rule.derived:
                if not signal.episode:
                    track.signals[signal.name] = first
                    first += 1
        self._client_values = ClientValues(context, tracks)
        self._of = [(track, DerivedColumns(track, self._leaf(track), context)) for track in tracks]

    def _leaf(self, track: Track) -> Callable[[Path], Hashable | Constant | None]:
        return lambda path: self._client_values.leaf(track, path)

    def compute(self, block: Block) -> None:
        """Add the signals to those of the block."""
        for track, derived in self._of:
            own = block.points(track.row)
            points = np.arange(block.shape[0] * block.shape[1]) if own is None else np.flatnonzero(own)
            clients, ticks = np.divmod(points, len(block.ticks))
            keys = np.array([track.earlier.number(client) for client in block.clients], np.int64)[clients]
            now = Evaluations(keys, block.times[ticks], block.ticks[-1])
            for each in derived.compute(self._rows(track, block, points), now):
                column = _scattered(each.column, points, block.shape[0] * block.shape[1])
                if each.signal.episode:
                    block.measured[track.row, each.signal.name] = column
                else:
                    block.signals.append(column)

    def _rows(self, track: Track, block: Block, points: Integers) -> Rows:
        possible = self._context.possible
        paths = {signal.name: signal.of.paths for signal in track.rule.derived if signal.of is not None}

        def note(field: str, row: int, reason: Reason, message: str, times: int) -> None:
            client = block.clients[int(points[row]) // len(block.ticks)]
            if reason is Reason.ABSENT and possible.limited:
                never = {signal.name for signal in track.rule.signals if not possible(signal.stream, client)}
                if any(path[0] in never for path in paths[field]):
                    return
            track.counters.note(reason, message, f"signal {field} of {track.subject(client).text}", times)

        def column(leaf: Hashable) -> Column:
            whole = self._client_values.at_points(block, leaf)
            return whole if len(points) == len(whole.values) else _picked(whole, points)

        return Rows(
            len(points), column, lambda row: block.variables(track, int(points[row])), note, not possible.limited
        )


def _picked(column: Column, rows: Integers) -> Column:
    return Column(
        column.values[rows],
        None if column.tags is None else column.tags[rows],
        None if column.others is None else column.others[rows],
    )


def _scattered(column: Column, points: Integers, size: int) -> Column:
    """The column over all points, absent elsewhere."""
    if len(points) == size:
        return column
    values, tags, others = np.zeros(size), np.zeros(size, np.uint8), None
    values[points], tags[points] = column.values, Tag.NUMBER if column.tags is None else column.tags
    if column.others is not None:
        others = np.full(size, None, object)
        others[points] = column.others
    return Column(values, tags, others)


def with_derived(
    rule: CompiledRule, earlier: EarlierValues, now: int, candidates: Iterable[Candidate], counters: RuleCounters
) -> Iterator[Candidate]:
    """The subjects with these signals among their variables, and with the values that statistics of episodes
    aggregate."""
    by_element: dict[str | None, list[Candidate]] = {}
    for candidate in candidates:
        by_element.setdefault(candidate.subject.element, []).append(candidate)
    for element in rule.elements:
        yield from _of_one(rule, earlier, now, element.name, by_element.get(element.name, []), counters)


def _of_one(
    rule: CompiledRule,
    earlier: EarlierValues,
    now: int,
    element: str | None,
    candidates: list[Candidate],
    counters: RuleCounters,
) -> Iterator[Candidate]:
    texts = Texts()
    variables: list[dict[str, Any]] = [dict(candidate.variables) for candidate in candidates]
    measured: list[dict[str, Any]] = [{} for _ in candidates]
    keys = np.array([earlier.key(candidate.subject) for candidate in candidates], np.int64)
    evaluations = Evaluations(keys, np.full(len(keys), now, np.int64), now)
    for signal in rule.derived:
        if signal.of is None:
            continue
        values = [
            evaluated(signal.of, seen, f"signal {signal.name} of {candidate.subject.text}", candidate.never, counters)
            for candidate, seen in zip(candidates, variables, strict=True)
        ]
        if not signal.episode:
            column = earlier.window(signal, element, evaluations, column_of(values, texts), texts, counters)
            values = [value_at(column, row, texts) for row in range(len(values))]
        for known, value in zip(measured if signal.episode else variables, values, strict=True):
            if value is not UNKNOWN:
                known[signal.name] = value
    for candidate, seen, over in zip(candidates, variables, measured, strict=True):
        yield candidate._replace(variables=seen, measured=over)
