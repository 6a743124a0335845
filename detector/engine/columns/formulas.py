"""Conditions over rows of any kind, such as pairs: in columns where they can be, by CEL elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.leaves import stacked
from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Verdict
from wayside.expressions import Expression, Path, Reason
from wayside.expressions.columns.graph import Graph
from wayside.expressions.columns.lowering import Constant
from wayside.expressions.columns.program import Program
from wayside.expressions.columns.values import Column, Texts


class Rows(NamedTuple):
    """What conditions are evaluated over."""

    size: int
    column: Callable[[Any], Column]
    """The column of a leaf."""
    variables: Callable[[int], Mapping[str, Any]]
    """What CEL sees at a row."""
    note: Callable[[str, int, Reason, str, int], None]
    """Told the field of a condition, a row, why the result is unknown there, and how many rows are like it."""
    alike: bool
    """Whether rows whose leaves have the same tags are counted together; else each row by itself."""


class Formulas:
    """Conditions by field; an absent one holds everywhere."""

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

    def evaluate(self, rows: Rows) -> Mapping[str, Verdict]:
        """The verdict of each condition on each row. Counts unknown results."""
        count = rows.size
        if not count or not self._conditions:
            return {field: Verdict(np.zeros(count, bool), np.zeros(count, bool)) for field in self._conditions}
        columns = [rows.column(leaf) for leaf in self._program.leaves]
        values, tags = stacked(columns, count)
        results = self._program.run(values, tags)
        found: dict[str, Verdict] = {}
        for field, node in self._nodes.items():
            if node is None:
                verdict = Verdict(np.zeros(count, bool), np.zeros(count, bool))
                self._ask(field, rows, np.arange(count), verdict)
            else:
                true, false = results.truths([node])
                verdict = Verdict(true[0].copy(), false[0].copy())
                foreign = results.foreign(node)
                self._note_unknown(field, rows, verdict, foreign, tags)
                if foreign is not None:
                    self._ask(field, rows, np.flatnonzero(foreign), verdict)
            found[field] = verdict
        return found

    def _ask(self, field: str, rows: Rows, at: NDArray[np.intp], verdict: Verdict) -> None:
        """Evaluate a condition by CEL at some rows."""
        for row in at.tolist():
            value, why = self._conditions[field].explained(rows.variables(row))
            verdict.true[row], verdict.false[row] = value is True, value is False
            if why is not None:
                rows.note(field, row, *why, 1)

    def _note_unknown(
        self, field: str, rows: Rows, verdict: Verdict, foreign: Truths | None, tags: NDArray[np.uint8] | None
    ) -> None:
        """Rows that look alike have one reason, which CEL gives for the last of them."""
        unknown = ~(verdict.true | verdict.false)
        at = np.flatnonzero(unknown if foreign is None else unknown & ~foreign)
        if not len(at):
            return
        which, counts = np.arange(len(at)), np.ones(len(at), np.int64)
        if rows.alike:
            kinds = np.zeros((1, len(at)), np.uint8) if tags is None or not len(tags) else tags[:, at]
            _, last, counts = np.unique(kinds[:, ::-1], axis=1, return_index=True, return_counts=True)
            which = len(at) - 1 - last
        for row, times in sorted(zip(at[which].tolist(), counts.tolist(), strict=True)):
            _, why = self._conditions[field].explained(rows.variables(row))
            if why is not None:
                rows.note(field, row, *why, times)
