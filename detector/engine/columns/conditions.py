"""Conditions about clients, for rules that are evaluated together, as one program over the points of a block.

CEL evaluates the conditions and points that the columns cannot: once for each run of ticks with the same inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.client_values import ClientValues
from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Ternary
from detector.engine.episodes.episodes import FALSE, TRUE, UNSURE
from wayside.expressions import Expression, Reason
from wayside.expressions.columns.lowering import Graph
from wayside.expressions.columns.program import Program
from wayside.expressions.columns.values import Tag, stacked
from wayside.rules import CompiledRule

_OF_CLIENTS = frozenset({"client", "labels", "parameters"})
"""Variables that differ between clients."""

_MAXIMUM_CACHED = 100_000
"""Maximum number of clients whose last result of CEL is cached."""


class ClientCondition(NamedTuple):
    """One of a rule's conditions, for one element."""

    field: str
    expression: Expression
    node: int | None
    """The node of its truth in the program; None: CEL evaluates the condition."""
    signals: tuple[int, ...]
    """Indices in the group of the signals that it reads."""
    streams: bool
    """Whether it reads the freshness of streams."""
    by_client: bool
    """Whether it reads variables that differ between clients."""


class _Field(NamedTuple):
    """A condition of all rules that have it."""

    has: Truths
    """Which tracks have it; shape (tracks, 1)."""
    rows: slice | list[int]
    """The tracks whose condition the program evaluates."""
    nodes: tuple[int, ...]
    """The nodes of these conditions' truths in the program."""
    in_columns: list[tuple[int, ClientCondition, int]]
    """The tracks of `rows`, with their conditions and nodes."""
    by_cel: list[tuple[int, ClientCondition]]
    """The tracks whose condition CEL evaluates."""

    @classmethod
    def of(cls, conditions: Sequence[ClientCondition | None]) -> _Field:
        """`conditions`: by track; None: it has none."""
        chosen = [(row, each) for row, each in enumerate(conditions) if each is not None]
        in_columns = [(row, each, each.node) for row, each in chosen if each.node is not None]
        rows = [row for row, _, _ in in_columns]
        return cls(
            np.array([[each is not None] for each in conditions]),
            slice(None) if len(rows) == len(conditions) else rows,
            tuple(node for _, _, node in in_columns),
            in_columns,
            [(row, each) for row, each in chosen if each.node is None],
        )


class Conditions:
    """Evaluates the conditions of a group of rules at the points of a block."""

    def __init__(
        self, context: Context, tracks: Sequence[Track], chosen: Callable[[CompiledRule], Mapping[str, Expression]]
    ) -> None:
        """`chosen` are a rule's conditions, by their names in errors. The tracks know the indices of their signals."""
        self._context = context
        self._tracks = tracks
        self._chosen = chosen
        self._client_values = ClientValues(context, tracks)
        self._graph = Graph()
        self._of: list[dict[str, ClientCondition]] = [self._conditions(track) for track in tracks]
        """By track and field."""
        fields = dict.fromkeys(field for each in self._of for field in each)
        self._by_field = {field: _Field.of([each.get(field) for each in self._of]) for field in fields}
        roots = [each.node for conditions in self._of for each in conditions.values() if each.node is not None]
        self._program = Program(self._graph, roots, context.tables.texts)
        self._cache: dict[tuple[int, str], dict[str, tuple[Hashable, int, tuple[Reason, str] | None]]] = {}

    def _conditions(self, track: Track) -> dict[str, ClientCondition]:
        found = dict[str, ClientCondition]()
        for field, expression in self._chosen(track.rule).items():
            node = self._graph.add(expression, lambda path: self._client_values.leaf(track, path))
            found[field] = ClientCondition(
                field,
                expression,
                None if node is None else self._graph.truth(node),
                tuple(at for name, at in track.signals.items() if name in expression.names),
                "streams" in expression.names,
                not _OF_CLIENTS.isdisjoint(expression.names),
            )
        return found

    def has(self, field: str) -> Truths:
        """Which tracks have the condition; shape (tracks, 1)."""
        return self._by_field[field].has

    def verdicts(self, block: Block) -> dict[str, Ternary]:
        """The verdicts, by field, shape (tracks, points); unknown in tracks without the field. Counts unknowns."""
        points = len(block.clients) * len(block.ticks)
        shape = (len(self._tracks), points)
        found: dict[str, Ternary] = {}
        values, tags = stacked([self._client_values.at_points(block, each) for each in self._program.leaves], points)
        results = self._program.run(values, tags)
        any_non_number = tags is not None and bool((tags > Tag.NUMBER).any())
        for field, these in self._by_field.items():
            true, false = found[field] = Ternary(np.zeros(shape, bool), np.zeros(shape, bool))
            if these.nodes:
                true[these.rows], false[these.rows] = results.truths(these.nodes)
            for row, condition in these.by_cel:
                self._evaluate_by_cel(block, row, condition, true[row], false[row])
            for row, condition, node in these.in_columns if any_non_number else ():
                cel_rows = results.cel_rows(node)
                if cel_rows is not None:
                    own = block.points(row)
                    cel_rows = cel_rows if own is None else cel_rows & own
                    for point in np.flatnonzero(cel_rows).tolist():
                        self._evaluate_point_by_cel(block, row, condition, point, true[row], false[row])
            unknown = ~(true | false)
            if unknown.any():
                for row, condition, _ in these.in_columns:
                    if unknown[row].any():
                        self._note_unknown(block, row, condition, unknown[row], tags)
        block.verdicts = found
        return found

    # CEL

    def _evaluate_by_cel(self, block: Block, row: int, condition: ClientCondition, true: Truths, false: Truths) -> None:
        """Evaluate a condition by CEL, at the points where any of its inputs changes."""
        count = len(block.ticks)
        changed = np.zeros(block.shape, bool)
        changed[:, 0] = True
        for at in condition.signals:
            column = block.signals[at]
            values = column.values.reshape(block.shape).view(np.int64)  # compares bits: 0.0 and -0.0 differ
            changed[:, 1:] |= values[:, 1:] != values[:, :-1]
            if column.tags is not None:
                tags = column.tags.reshape(block.shape)
                changed[:, 1:] |= (tags[:, 1:] != tags[:, :-1]) | (tags[:, 1:] == Tag.OTHER)
        if condition.streams:
            for fresh in block.fresh.values():
                changed[:, 1:] |= fresh[:, 1:] != fresh[:, :-1]
        if block.present is not None:
            changed &= block.present
            changed[:, 1:] |= block.present[:, 1:] & ~block.present[:, :-1]
        if block.selected is not None:
            changed &= block.selected[row][:, None]
        points = np.flatnonzero(changed).tolist()
        if not points:
            return
        for point, following in zip(points, [*points[1:], block.shape[0] * count], strict=True):
            end = min(following, (point // count + 1) * count)
            self._evaluate_point_by_cel(block, row, condition, point, true, false, end - point)

    def _evaluate_point_by_cel(
        self,
        block: Block,
        row: int,
        condition: ClientCondition,
        point: int,
        true: Truths,
        false: Truths,
        times: int = 1,
    ) -> None:
        """Evaluate a condition by CEL at a point, and use the result for the next `times` points."""
        track, client = self._tracks[row], block.clients[point // len(block.ticks)]
        cache = self._cache.setdefault((row, condition.field), {})
        key = self._inputs(block, condition, point)
        known = cache.get(client)
        if key is None or known is None or known[0] != key:
            value, note = condition.expression.explained(block.variables(track, point))
            known = (key, TRUE if value is True else FALSE if value is False else UNSURE, note)
            if len(cache) > _MAXIMUM_CACHED:
                cache.clear()
            cache[client] = known
        _, result, note = known
        true[point : point + times] = result == TRUE
        false[point : point + times] = result == FALSE
        if note is not None:
            self._note(block, row, condition, point, note, times)

    def _inputs(self, block: Block, condition: ClientCondition, point: int) -> Hashable | None:
        """A key that differs whenever the inputs of a condition differ; None: evaluate it each time."""
        inputs: list[Hashable] = []
        for at in condition.signals:
            column = block.signals[at]
            tag = int(Tag.NUMBER if column.tags is None else column.tags[point])
            if tag == Tag.OTHER:
                return None
            value = float(column.values[point])
            inputs.append((tag, value, math.copysign(1, value)))
        if condition.streams:
            inputs.append(tuple(bool(fresh.flat[point]) for fresh in block.fresh.values()))
        return tuple(inputs)

    def _note_unknown(
        self, block: Block, row: int, condition: ClientCondition, unknown: Truths, tags: NDArray[np.uint8] | None
    ) -> None:
        """Count a condition's unknown results. Points with the same tags share one reason, which CEL gives for the
        last."""
        own = block.points(row)
        points = np.flatnonzero(unknown if own is None else unknown & own)
        if not len(points):
            return
        groups = np.zeros(len(points), np.int64)
        for at in condition.signals:
            column = block.signals[at]
            groups = groups * 8 + (Tag.NUMBER if column.tags is None else column.tags[points].astype(np.int64))
        if condition.by_client or self._context.possible.limited:
            groups = groups * len(block.clients) + points // len(block.ticks)
        kinds, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
        for kind in range(len(kinds)):
            point = block.last(points[inverse == kind])
            _, note = condition.expression.explained(block.variables(self._tracks[row], point))
            if note is not None:
                self._note(block, row, condition, point, note, int(counts[kind]))

    def _note(
        self, block: Block, row: int, condition: ClientCondition, point: int, note: tuple[Reason, str], times: int
    ) -> None:
        track, client = self._tracks[row], block.clients[point // len(block.ticks)]
        reason, message = note
        possible = self._context.possible
        if reason is Reason.ABSENT and possible.limited:
            never = {signal.name for signal in track.rule.signals if not possible(signal.stream, client)}
            if any(path[0] in never for path in condition.expression.paths):
                return
        name = track.subject(client).text if condition.field in track.place else client
        track.counters.note(
            reason, message, f"{condition.field} of {name}{track.place.get(condition.field, '')}", times
        )
