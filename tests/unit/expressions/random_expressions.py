"""Random expressions over rows, and rows as columns."""

import math
import random
import struct
from collections.abc import Mapping, Sequence

import numpy as np
from hypothesis import strategies as st

from wayside.expressions import CelType, Environment, Expression, ExpressionError, Path
from wayside.expressions.columns import MISSING, Graph, Program, Results, Tag, Texts, column_of, value_at

FIELDS = ("a", "b", "c", "e")
DECLARED = {"d": CelType.DOUBLE, "f": CelType.BOOL, "s": CelType.STRING}
ENVIRONMENT = Environment({"m": CelType.DYN} | DECLARED)
Row = Mapping[str, object]


def by_path(path: Path) -> str:
    return str(path[-1])


class Table:
    """Rows as columns: a leaf for each field of `m` and each declared variable."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.texts = Texts()
        self.rows = rows

    def run(self, graph: Graph, roots: Sequence[int]) -> Results:
        program = Program(graph, roots, self.texts)
        columns = [column_of([row.get(str(name), MISSING) for row in self.rows], self.texts) for name in program.leaves]
        values = np.array([column.values for column in columns]).reshape(len(columns), len(self.rows))
        if all(column.tags is None for column in columns):
            return program.run(values, None)
        numbers = np.full(len(self.rows), Tag.NUMBER, np.uint8)
        tags = np.array([numbers if column.tags is None else column.tags for column in columns])
        return program.run(values, tags)

    def by_cel(self, expression: Expression) -> list[object]:
        return [
            expression.evaluate_or_unknown(
                {name: row[name] for name in DECLARED if name in row}
                | {"m": {name: row[name] for name in FIELDS if name in row}}
            )
            for row in self.rows
        ]

    def by_columns(self, expression: Expression) -> list[object] | None:
        """The results of columns, or FOREIGN, row by row."""
        graph = Graph()
        root = graph.add(expression, by_path)
        if root is None:
            return None
        truth = graph.truth(root)
        results = self.run(graph, (root, truth))
        column, cel_rows = results.column(root), results.cel_rows(root)
        values: list[object] = []
        for row in range(len(self.rows)):
            if cel_rows is not None and cel_rows[row]:
                values.append(FOREIGN)
            elif column.tags is not None and column.tags[row] == Tag.OTHER:
                values.append(OTHER)
            else:
                values.append(value_at(column, row, self.texts))
        true, false = results.truths((truth,))
        for row, value in enumerate(values):
            if value is not FOREIGN:
                assert (bool(true[0, row]), bool(false[0, row])) == (value is True, value is False)
        return values


FOREIGN, OTHER = object(), object()


def same(one: object, other: object) -> bool:
    """Equal to the last bit."""
    if isinstance(one, float) and isinstance(other, float):
        return struct.pack("<d", one) == struct.pack("<d", other)
    return type(one) is type(other) and one == other


DOUBLES = st.one_of(
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 2.0, 0.5, math.inf, -math.inf, 5e-324, 1e308, 2.0**53, math.nan]),
    st.floats(),
    st.integers(-3, 3),
)
PLAIN = st.one_of(DOUBLES, st.none())
ANYTHING = st.one_of(
    PLAIN,
    st.booleans(),
    st.sampled_from(["x", "y", "", "x\0", "␀", b"bytes", 2**60, -(2**53) - 1, 2**64, [1.0], [], {"k": 1.0}, [None]]),
)


def rows_of(values: st.SearchStrategy[object]) -> st.SearchStrategy[list[Row]]:
    row = st.dictionaries(st.sampled_from(FIELDS), values)
    declared = st.fixed_dictionaries({}, optional={"d": values, "f": values, "s": values})
    return st.lists(st.builds(lambda one, other: one | other, row, declared), min_size=1, max_size=6)


class ExpressionGenerator:
    """Writes expressions at random."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def _one(self, *choices: str) -> str:
        return self._random.choice(choices)

    def field(self) -> str:
        return f"m.{self._random.choice(FIELDS)}"

    def number(self, depth: int) -> str:
        part = self._random.randrange(9) if depth else 0
        one, other = (self.number(depth - 1), self.number(depth - 1)) if part else ("", "")
        match part:
            case 1:
                return f"(-{one})"
            case 2:
                return f"{self._one(*UNARY)}({one})"
            case 3:
                return f"{self._one(*BINARY)}({one}, {other})"
            case 4:
                return f"({self.field()} > 0 ? {one} : {other})"
            case 5:
                return f"timeToCollision({one}, {other}, m.a, 2, 1)"
            case 6 | 7 | 8:
                return f"({one} {self._one(*'+-*/')} {other})"
        return self._one(self.field(), self.field(), "d", *LITERALS)

    def comparison(self) -> str:
        order = self._one("<", "<=", ">", ">=", "==", "!=")
        match self._random.randrange(6):
            case 0:
                return f"has({self.field()})"
            case 1:
                return f"({self.field()} in {self._one('[1, 2.5, -1]', '[0.0]', '[2, 2, 0.5, 1e308, 7]')})"
            case 2:
                return f"({self.field()} {order} {self.field()})"
        return f"({self.number(2)} {order} {self.number(2)})"

    def truth(self, depth: int) -> str:
        part = self._random.randrange(6) if depth else 0
        one, other = (self.truth(depth - 1), self.truth(depth - 1)) if part else ("", "")
        match part:
            case 1:
                return f"!{one}"
            case 2:
                return f"({one} {self._one('==', '!=', '<', '>=')} {other})"
            case 3:
                return f"({self.truth(depth - 1)} ? {one} : {other})"
            case 4 | 5:
                return f"({one} {self._one('&&', '||')} {other})"
        return self._one(self.comparison(), self.comparison(), self.comparison(), self.field(), "true", "false")

    def anything(self, depth: int) -> str:
        """Of any type, texts and declared variables among it."""
        part = self._random.randrange(8) if depth else 0
        one, other = (self.anything(depth - 1), self.anything(depth - 1)) if part else ("", "")
        match part:
            case 1:
                return f"({self.truth(1)} ? {one} : {other})"
            case 2 | 3:
                return f"({one} {self._one('==', '!=')} {other})"
            case 4:
                return f"({one} {self._one('<', '<=', '+', '-')} {other})"
            case 5:
                return f"({one} {self._one('&&', '||')} {other})"
            case 6:
                return f"({one} in {LIST})"
            case 7:
                return f"has({self.field()})"
        return self._one(self.field(), self.field(), self.field(), "s", "f", "d", "'x'", "'␀'", "true", self.number(1))


LITERALS = ("0.0", "-0.0", "1", "2.5", "-1", "1e308", "(1.0/0.0)")
UNARY = ("abs", "sqrt", "sin", "cos", "degrees", "radians")
BINARY = ("smaller", "larger", "hypot", "atan2", "headingDifference", "timeToCollision")
LIST = "['x', 0.0, true, '']"
AUTHORS = st.integers(0, 2**32).map(ExpressionGenerator)
KINDS = st.sampled_from([CelType.DYN, CelType.DYN, CelType.BOOL, CelType.DOUBLE, CelType.STRING])


def compiled(source: str, kind: CelType = CelType.DYN) -> Expression | None:
    """None for what CEL's own check of types refuses."""
    try:
        return ENVIRONMENT.compile(source, result=kind)
    except ExpressionError:
        return None
