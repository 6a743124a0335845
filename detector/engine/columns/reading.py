"""The values that rules read from each sample of a stream, as columns of its table: read once, on first use.

The fields of all expressions are read together. CEL evaluates the rest row by row: values that the columns cannot
decide, and expressions that they cannot represent.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.buffering.messages import Messages
from detector.engine.columns.fields import OF_A_SAMPLE, SampleFields
from detector.engine.columns.table import Integers, StoredColumn, Table
from detector.engine.counters import Counters
from detector.engine.samples.sample import DecodeError, Decoder, Sample
from wayside.expressions import UNKNOWN, Expression, Path, Reason, Unknown, Value
from wayside.expressions.columns.lowering import Constant, Graph
from wayside.expressions.columns.program import Program, Results
from wayside.expressions.columns.values import Column, Tag, Texts, column_of, stacked
from wayside.rules import CompiledElement
from wayside.rules.parameters import Parameters

_CONSTANTS = (bool, float, str)


class SampleExpression(NamedTuple):
    """An expression over one sample, as written in a rule."""

    expression: Expression
    parameters: Parameters
    element: CompiledElement | None


class Failure(NamedTuple):
    """Samples of a client for which an expression has no value."""

    client: int
    reason: Reason | None
    """None: the samples cannot be read at all."""
    message: str
    samples: int


class UsedColumns(NamedTuple):
    """The columns of a table that a signal uses: those of its `value` and its `where`; None: it has none."""

    value: int | None
    where: int | None


class Reader:
    """Fills the columns of one stream's table."""

    def __init__(
        self,
        stream: str,
        decoder: Decoder,
        texts: Texts,
        messages: Messages,
        counters: Counters,
        names: Sequence[str],
    ) -> None:
        """`names` are the clients' names, by their numbers."""
        self._stream = stream
        self._decoder = decoder
        self._texts = texts
        self._messages = messages
        self._counters = counters
        self._names = names
        self._graph = Graph()
        self._index: dict[Hashable, int] = {}
        self._readings: list[SampleExpression] = []
        """By column: the first of equal expressions."""
        self._nodes: list[int | None] = []
        self._used: dict[UsedColumns, None] = {}
        self._paths: list[Path] = []
        self._fields_at: dict[int, int] = {}
        """For nodes that are a plain field, its index among the paths."""
        self._program: Program | None = None
        self._fields: SampleFields | None = None

    @property
    def count(self) -> int:
        """Number of columns."""
        return len(self._readings)

    def use(self, value: SampleExpression | None, where: SampleExpression | None) -> UsedColumns:
        """The columns that a signal needs."""
        used = UsedColumns(
            None if value is None else self._column(value), None if where is None else self._column(where)
        )
        self._used.setdefault(used)
        return used

    def read(self, table: Table, rows: Integers) -> Mapping[UsedColumns, Sequence[Failure]]:
        """Fill these rows of the table, which are not filled yet. Returns the rows without a value, for each use."""
        if self._program is None:
            self._prepare()
        samples: list[Sample] = table.samples[rows].tolist()
        table.filled[rows] = True
        clients = table.clients_of(rows)
        batch = _Batch(samples, clients, self._leaves(samples))
        done: dict[int, tuple[Column, dict[int, tuple[Reason, str]]]] = {}
        for at, node in enumerate(self._nodes):
            done[at] = self._evaluated(batch, at, node)
            _store(table.columns[at], rows, done[at][0])
        return {used: found for used in self._used if (found := [*self._failures(batch, used, done)])}

    def failures(self, table: Table, rows: Integers, used: UsedColumns) -> Iterator[Failure]:
        """Which of these filled rows have no value for a use, and why."""
        for at in (used.where, used.value):
            if at is None:
                continue
            tags, values = table.columns[at].tags[rows], table.columns[at].values[rows]
            missing = rows[tags == Tag.ABSENT]
            if len(missing):
                batch = _Batch(table.samples[missing].tolist(), table.clients_of(missing), _Leaves(None, [], {}, ()))
                for row in range(len(missing)):
                    why: tuple[Reason | None, str] = self._value_by_cel(at, batch, row)[1] or (None, "")
                    yield Failure(int(batch.clients[row]), *why, 1)
            if at == used.where:
                rows = rows[(tags == Tag.BOOLEAN) & (values == 1)]

    def _column(self, reading: SampleExpression) -> int:
        node = self._graph.add(reading.expression, lambda path: _leaf(path, reading))
        key: Hashable = node
        if node is None:
            names = reading.expression.names
            key = (
                reading.expression.source,
                id(reading.parameters) if "parameters" in names else None,
                None
                if reading.element is None or not names & reading.element.variables.keys()
                else id(reading.element),
            )
        if key not in self._index:
            self._index[key] = len(self._readings)
            self._readings.append(reading)
            self._nodes.append(node)
            self._program = None
        return self._index[key]

    def _prepare(self) -> None:
        nodes = [node for node in self._nodes if node is not None]
        self._program = Program(self._graph, nodes, self._texts)
        self._paths = [path for path in self._program.leaves if isinstance(path, tuple)]
        self._fields_at = {self._graph.leaf(path): at for at, path in enumerate(self._paths)}
        self._fields = SampleFields(self._stream, self._decoder, self._messages.items, self._paths)

    def _leaves(self, samples: Sequence[Sample]) -> _Leaves:
        """The fields of the samples, and the program's results."""
        assert self._program is not None  # noqa: S101  the caller prepared it
        assert self._fields is not None  # noqa: S101
        if not self._paths:
            return _Leaves(None, [], {}, ())
        fields = self._fields.read(samples, self._texts)
        for at, error in fields.errors.items():
            self._messages.unreadable(self._stream, samples[at], error)
        return _Leaves(self._program, fields.columns, fields.errors, fields.odd)

    def _evaluated(self, batch: _Batch, at: int, node: int | None) -> tuple[Column, dict[int, tuple[Reason, str]]]:
        """A column's values for the batch, and by row the reason why CEL has none."""
        count, leaves = len(batch.samples), batch.leaves
        failed: dict[int, tuple[Reason, str]] = {}
        if node is None or not leaves.columns:
            return self._by_cel(at, batch, range(count), failed), failed
        odd = set(leaves.odd)
        if node in self._fields_at:
            column = leaves.columns[self._fields_at[node]]
            if column.tags is None and not leaves.errors and not odd:
                return column, failed
            if column.others is not None and column.tags is not None:  # in the form of CEL's lists and maps
                odd.update(np.flatnonzero(column.tags == Tag.OTHER).tolist())
        else:
            column = leaves.results.column(node)
        if leaves.errors:
            nothing = Column(np.zeros(len(leaves.errors)), np.zeros(len(leaves.errors), np.uint8), None)
            column = _replaced(column, np.array([*leaves.errors]), nothing)
        cel_rows = leaves.results.cel_rows(node)
        if cel_rows is not None:
            odd.update(np.flatnonzero(cel_rows).tolist())
        odd.difference_update(leaves.errors)
        if odd:
            ordered = sorted(odd)
            some = self._by_cel(at, batch, ordered, failed)
            column = _replaced(column, np.array(ordered), some)
        return column, failed

    def _by_cel(self, at: int, batch: _Batch, rows: Sequence[int], failed: dict[int, tuple[Reason, str]]) -> Column:
        values = []
        for row in rows:
            value, why = self._value_by_cel(at, batch, row)
            values.append(value)
            if why is not None:
                failed[row] = why
        return column_of(values, self._texts)

    def _value_by_cel(self, at: int, batch: _Batch, row: int) -> tuple[Value | Unknown, tuple[Reason, str] | None]:
        """The value of a row by CEL, and the reason if it has none; None if the sample cannot be read."""
        reading, sample = self._readings[at], batch.samples[row]
        parameters = reading.parameters.of(self._names[batch.clients[row]])
        if "msg" in reading.expression.names and row in batch.leaves.errors:
            return UNKNOWN, None
        values = self._messages.values(self._stream, sample, reading.expression.names, parameters)
        if values is None:
            batch.leaves.errors[row] = DecodeError()  # counted already
            return UNKNOWN, None
        if reading.element is not None:
            values.update(reading.element.variables)
        return reading.expression.explained(values)

    def _failures(
        self,
        batch: _Batch,
        used: UsedColumns,
        done: Mapping[int, tuple[Column, Mapping[int, tuple[Reason, str]]]],
    ) -> Iterator[Failure]:
        """The samples without a value for a use: first those whose `where` has none, then those selected whose `value`
        has none."""
        taken: NDArray[np.bool_] | None = None
        for at in (used.where, used.value):
            if at is None:
                continue
            column, failed = done[at]
            if column.tags is not None:
                missing = column.tags == Tag.ABSENT
                if taken is not None:
                    missing &= taken
                if missing.any():
                    yield from self._explained(batch, at, np.flatnonzero(missing).tolist(), failed)
            if at == used.where and at is not None:
                true = column.values == 1
                taken = true & (column.tags == Tag.BOOLEAN) if column.tags is not None else np.zeros(len(true), bool)

    def _explained(
        self, batch: _Batch, at: int, rows: Sequence[int], failed: Mapping[int, tuple[Reason, str]]
    ) -> Iterator[Failure]:
        """Rows with the same tags share one explanation, which CEL gives for the first of them."""
        known: dict[Hashable, tuple[Reason | None, str]] = {}
        counts: dict[tuple[int, Reason | None, str], int] = {}
        kinds = [None if each.tags is None else each.tags for each in batch.leaves.columns]
        for row in rows:
            why: tuple[Reason | None, str]
            if row in batch.leaves.errors:
                why = (None, "")
            elif row in failed:
                why = failed[row]
            else:
                tags = tuple([Tag.NUMBER if each is None else int(each[row]) for each in kinds])
                if tags not in known:
                    known[tags] = self._value_by_cel(at, batch, row)[1] or (None, "")
                why = known[tags]
            which = (int(batch.clients[row]), *why)
            counts[which] = counts.get(which, 0) + 1
        for (client, reason, message), count in counts.items():
            yield Failure(client, reason, message, count)


class _Leaves:
    """The fields of some samples."""

    def __init__(
        self,
        program: Program | None,
        columns: Sequence[Column],
        errors: dict[int, DecodeError],
        odd: Collection[int],
    ) -> None:
        self._program = program
        self.columns = columns
        self.errors = errors
        self.odd = odd

    @cached_property
    def results(self) -> Results:
        """The program's results; there must be columns."""
        assert self._program is not None  # noqa: S101  the caller looked
        return self._program.run(*stacked(self.columns, len(self.columns[0].values)))


class _Batch(NamedTuple):
    """Samples that are read together."""

    samples: Sequence[Sample]
    clients: Integers
    leaves: _Leaves


def _leaf(path: Path, reading: SampleExpression) -> Hashable | Constant | None:
    """The column of a path in an expression over one sample: a field, or a constant for all samples."""
    name, below = path[0], path[1:]
    if name in OF_A_SAMPLE:
        return path if below else None
    variables: Mapping[str, Any] = {} if reading.element is None else reading.element.variables
    if name == "parameters" and not reading.parameters.overridden:
        variables = {"parameters": reading.parameters.own}
    return constant(variables, path)


def constant(variables: Mapping[str, Any], path: Path) -> Constant | None:
    """The value at a path, if it is a number, a text or a boolean."""
    value: Any = variables
    for step in path:
        if not isinstance(value, Mapping) or step not in value:
            return None
        value = value[step]
    return Constant(value) if type(value) in _CONSTANTS and value == value else None  # noqa: PLR0124 (no NaN)


def _store(stored: StoredColumn, rows: Integers, column: Column) -> None:
    stored.values[rows] = column.values
    if column.tags is None:
        stored.tags[rows] = Tag.NUMBER
        return
    stored.tags[rows] = column.tags
    stored.odd = stored.odd or bool((column.tags != Tag.NUMBER).any())
    if column.others is not None:
        if stored.others is None:
            stored.others = np.empty(len(stored.values), object)
        stored.others[rows] = column.others


def _replaced(column: Column, rows: Integers, by: Column) -> Column:
    """The column with other values in some rows."""
    values = column.values.copy()
    tags = np.full(len(values), Tag.NUMBER, np.uint8) if column.tags is None else column.tags.copy()
    others = None if column.others is None else column.others.copy()
    values[rows] = by.values
    tags[rows] = Tag.NUMBER if by.tags is None else by.tags
    if by.others is not None:
        others = np.empty(len(values), object) if others is None else others
        others[rows] = by.others
    return Column(values, tags, others)
