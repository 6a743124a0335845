"""Conditions over rows of any kind, such as pairs: in columns if possible, otherwise by CEL."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Ternary
from wayside.expressions import Expression, Path, Reason
from wayside.expressions.columns.lowering import Constant, Graph
from wayside.expressions.columns.nodes import Op
from wayside.expressions.columns.program import Program
from wayside.expressions.columns.values import Column, Tag, Texts, column_of, stacked


class Rows(NamedTuple):
    """The rows over which conditions are evaluated."""

    size: int
    column: Callable[[Any], Column]
    """The column of a leaf."""
    variables: Callable[[int], Mapping[str, Any]]
    """The variables of CEL at a row."""
    note: Callable[[str, int, Reason, str, int], None]
    """Receives the field of a condition, a row, the reason why the result is unknown there, and the number of rows like
    it."""
    alike: bool
    """Whether rows whose leaves have the same tags are counted together; otherwise each row separately."""


class Formulas:
    """Conditions by field; an absent condition is true everywhere."""

    def __init__(
        self,
        conditions: Mapping[str, Expression | None],
        leaf: Callable[[Path], Hashable | Constant | None],
        texts: Texts,
    ) -> None:
        graph = Graph()
        self._conditions = {field: each for field, each in conditions.items() if each is not None}
        self._nodes: dict[str, int | None] = {}
        for field, expression in self._conditions.items():
            node = graph.add(expression, leaf)
            self._nodes[field] = None if node is None else graph.truth(node)
        self._program = Program(graph, [node for node in self._nodes.values() if node is not None], texts)

    def __bool__(self) -> bool:
        return bool(self._conditions)

    def evaluate(self, rows: Rows) -> Mapping[str, Ternary]:
        """The verdict of each condition on each row. Counts unknown results."""
        count = rows.size
        if not count or not self._conditions:
            return {field: Ternary(np.zeros(count, bool), np.zeros(count, bool)) for field in self._conditions}
        columns = [rows.column(leaf) for leaf in self._program.leaves]
        values, tags = stacked(columns, count)
        results = self._program.run(values, tags)
        found: dict[str, Ternary] = {}
        for field, node in self._nodes.items():
            if node is None:
                verdict = Ternary(np.zeros(count, bool), np.zeros(count, bool))
                self._evaluate_by_cel(field, rows, np.arange(count), verdict)
            else:
                true, false = results.truths([node])
                verdict = Ternary(true[0].copy(), false[0].copy())
                cel_rows = results.cel_rows(node)
                self._note_unknown(field, rows, verdict, cel_rows, tags)
                if cel_rows is not None:
                    self._evaluate_by_cel(field, rows, np.flatnonzero(cel_rows), verdict)
            found[field] = verdict
        return found

    def _evaluate_by_cel(self, field: str, rows: Rows, at: NDArray[np.intp], verdict: Ternary) -> None:
        """Evaluate a condition by CEL at some rows."""
        for row in at.tolist():
            value, why = self._conditions[field].explained(rows.variables(row))
            verdict.true[row], verdict.false[row] = value is True, value is False
            if why is not None:
                rows.note(field, row, *why, 1)

    def _note_unknown(
        self, field: str, rows: Rows, verdict: Ternary, cel_rows: Truths | None, tags: NDArray[np.uint8] | None
    ) -> None:
        unknown = ~(verdict.true | verdict.false)
        at = np.flatnonzero(unknown if cel_rows is None else unknown & ~cel_rows)
        _note_unknown(field, self._conditions[field], rows, at, tags)


class Formula:
    """An expression of any kind over rows."""

    def __init__(
        self, name: str, expression: Expression, leaf: Callable[[Path], Hashable | Constant | None], texts: Texts
    ) -> None:
        """`name` is the name in errors."""
        self._name, self._expression, self._texts = name, expression, texts
        graph = Graph()
        self._node = graph.add(expression, leaf)
        self._is_leaf = self._node is not None and graph.nodes[self._node].op is Op.LEAF
        self._program = Program(graph, [] if self._node is None else [self._node], texts)

    def column(self, rows: Rows) -> Column:
        """The value of each row. Counts unknown values."""
        if self._node is None or not rows.size:
            empty = Column(np.zeros(rows.size), np.zeros(rows.size, np.uint8), None)
            return self._with_values_by_cel(rows, np.arange(rows.size), empty) if rows.size else empty
        columns = [rows.column(leaf) for leaf in self._program.leaves]
        if self._is_leaf:
            column, tags, cel_rows = columns[0], columns[0].tags, None
        else:
            values, tags = stacked(columns, rows.size)
            results = self._program.run(values, tags)
            column, cel_rows = results.column(self._node), results.cel_rows(self._node)
            tags = column.tags
        if tags is not None:
            unknown = (tags == Tag.ABSENT) | (tags == Tag.UNREACHABLE)
            at = np.flatnonzero(unknown if cel_rows is None else unknown & ~cel_rows)
            kinds = [each.tags if each.tags is not None else np.ones(rows.size, np.uint8) for each in columns]
            _note_unknown(self._name, self._expression, rows, at, np.stack(kinds) if kinds else None)
        return column if cel_rows is None else self._with_values_by_cel(rows, np.flatnonzero(cel_rows), column)

    def _with_values_by_cel(self, rows: Rows, at: NDArray[np.intp], column: Column) -> Column:
        """The column, with the values from CEL for some rows."""
        found: list[object] = []
        for row in at.tolist():
            value, why = self._expression.explained(rows.variables(row))
            found.append(value)
            if why is not None:
                rows.note(self._name, row, *why, 1)
        own = column_of(found, self._texts)
        values, others = column.values.copy(), column.others
        tags = np.full(rows.size, Tag.NUMBER, np.uint8) if column.tags is None else column.tags.copy()
        values[at], tags[at] = own.values, Tag.NUMBER if own.tags is None else own.tags
        if own.others is not None:
            others = np.full(rows.size, None, object) if others is None else others.copy()
            others[at] = own.others
        return Column(values, tags, others)


def _note_unknown(
    field: str, expression: Expression, rows: Rows, at: NDArray[np.intp], tags: NDArray[np.uint8] | None
) -> None:
    """Rows with the same tags share one reason, which CEL gives for the last of them; `tags` are those of the
    leaves."""
    if not len(at):
        return
    which, counts = np.arange(len(at)), np.ones(len(at), np.int64)
    if rows.alike:
        kinds = np.zeros((1, len(at)), np.uint8) if tags is None or not len(tags) else tags[:, at]
        _, last, counts = np.unique(kinds[:, ::-1], axis=1, return_index=True, return_counts=True)
        which = len(at) - 1 - last
    for row, times in sorted(zip(at[which].tolist(), counts.tolist(), strict=True)):
        _, why = expression.explained(rows.variables(row))
        if why is not None:
            rows.note(field, row, *why, times)
