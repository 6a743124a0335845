"""Expressions over columns yield what CEL yields row by row, and report where only CEL can."""

import math
import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.expressions.random_expressions import (
    ANYTHING,
    ENVIRONMENT,
    FOREIGN,
    KINDS,
    OTHER,
    PLAIN,
    ExpressionGenerator,
    Row,
    Table,
    by_path,
    compiled,
    rows_of,
    same,
)
from wayside.expressions import UNKNOWN, CelType, Path
from wayside.expressions.columns import (
    MISSING,
    NOWHERE,
    Column,
    Constant,
    Graph,
    Program,
    Tag,
    Texts,
    column_of,
    value_at,
)
from wayside.expressions.columns.functions import SCALAR, VECTORISED, calculate


@given(st.integers(0, 2**32), KINDS, rows_of(ANYTHING))
@settings(max_examples=100, deadline=None)
def test_rows_have_the_values_that_cel_gives(seed: int, kind: CelType, rows: list[Row]) -> None:
    table, author = Table(rows), ExpressionGenerator(seed)
    for source in (author.number(3), author.truth(3), *(author.anything(2) for _ in range(4))):
        expression = compiled(source, kind)
        found = None if expression is None else table.by_columns(expression)
        if expression is None or found is None:
            continue
        for row, value, expected in zip(rows, found, table.by_cel(expression), strict=True):
            assert value in (FOREIGN, OTHER) or same(value, expected), (source, row, value, expected)


@given(st.integers(0, 2**32), rows_of(PLAIN))
@settings(max_examples=100, deadline=None)
def test_numbers_and_absent_values_never_need_cel(seed: int, rows: list[Row]) -> None:
    table, author = Table(rows), ExpressionGenerator(seed)
    for source in (author.number(3), author.truth(3), author.truth(2)):
        expression = compiled(source)
        if expression is None:
            continue
        found = table.by_columns(expression)
        assert found is not None, source
        for row, value, expected in zip(rows, found, table.by_cel(expression), strict=True):
            assert same(value, expected), (source, row, value, expected)


INNER = [
    "smaller(m.a / 0 * 0, 1) == 1",
    "abs(m.a - m.a / 0.0 + m.a / 0.0) > 0",
    "m.a / 0 - m.a / 0 == m.a",
    "!(m.a / 0 - m.a / 0 < m.a)",
    "sqrt(-m.a) > 1 || m.a > 0",
    "m.a < (m.b > 0)",
    "!(m.a <= (m.b > 0)) || m.c > 0",
    "(m.a > 0 ? 'x' : m.b) < m.c",
    "!((m.a > 0 ? 'x' : m.b) < m.c) || m.a > 0",
    "(m.a > 0 ? 'x' : m.b) + m.c",
    "((m.a > 0 ? 'x' : m.b) + m.c > 0) || m.a > 1",
    "(m.a > 0 ? true : m.b) && m.c > 0",
    "m.a && m.b > 0",
    "m.a || m.b > 0",
    "!m.a",
    "m.a ? m.b : m.c",
    "(m.a > 0 ? m.b > 0 : m.c) == true",
    "m.a == true || m.b == 'x'",
    "m.a in ['x', true]",
    "has(m.a) == true",
]


@pytest.mark.parametrize("source", INNER)
@pytest.mark.parametrize("others", [(), ({"a": None, "b": 1.0, "c": 1.0},)], ids=["numbers", "absent"])
def test_numbers_of_the_wrong_type_are_unknown_or_nan_as_in_cel(source: str, others: Sequence[Row]) -> None:
    table = Table([*({"a": a, "b": b, "c": 1.0} for a in (0.0, 1.0, -1.0) for b in (1.0, -1.0)), *others])
    expression = ENVIRONMENT.compile(source)
    found, expected = table.by_columns(expression), table.by_cel(expression)
    assert found is not None
    assert all(value is not FOREIGN for value in found)
    assert all(map(same, found, expected)), (found, expected)


def test_equal_subexpressions_of_two_rules_share_a_node() -> None:
    graph = Graph()
    one = graph.add(ENVIRONMENT.compile("m.a * 2 > m.b && m.c == 'x'"), by_path)
    count = len(graph.nodes)
    assert graph.add(ENVIRONMENT.compile("m.c == 'x' && m.b < m.a * 2"), by_path) == one
    assert len(graph.nodes) == count
    graph.add(ENVIRONMENT.compile("m.a * 2 > m.b || m.c == 'x'"), by_path)
    assert len(graph.nodes) == count + 1


def test_zeros_of_either_sign_stay_apart() -> None:
    graph = Graph()
    roots = [graph.add(ENVIRONMENT.compile(source), by_path) for source in ("m.a / 0.0", "m.a / -0.0")]
    results = Table([{"a": 1.0}]).run(graph, [root for root in roots if root is not None])
    assert [results.column(root).values[0] for root in roots if root is not None] == [math.inf, -math.inf]


REFUSED = (
    "m.a == null", "m.a < 'x'", "m.a + 'x' == 'y'", "m.a.startsWith('x')", "m.a[m.b] > 1", "m.a in [m.b]", "m.a in []",
    "size(m.a) > 1", "m.a == 9007199254740993", "m.a.exists(x, x > 1)", "yaw(m.a) > 1", "m.a[0] == 1",
)  # fmt: skip


@pytest.mark.parametrize("source", REFUSED)
def test_expressions_only_for_cel_leave_no_nodes_in_the_graph(source: str) -> None:
    graph = Graph()
    kept = graph.add(ENVIRONMENT.compile("m.a > 1"), by_path)
    before = list(graph.nodes)
    assert graph.add(ENVIRONMENT.compile(f"m.b > 7 && {source}"), lambda path: path) is None
    assert graph.nodes == before
    assert graph.add(ENVIRONMENT.compile("m.a > 1"), by_path) == kept


def test_a_path_without_a_column_is_left_to_cel() -> None:
    assert Graph().add(ENVIRONMENT.compile("m.a > 1 && m.b > 1"), lambda path: "a" if path[-1] == "a" else None) is None


def test_leaves_are_shared_by_name_and_only_those_of_the_roots_are_requested() -> None:
    graph = Graph()
    root = graph.add(ENVIRONMENT.compile("m.a > m.b"), lambda _: "same")
    other = graph.add(ENVIRONMENT.compile("m.a > m.c"), by_path)
    assert root is not None
    assert other is not None
    assert Program(graph, [root], Texts()).leaves == ("same",)
    assert set(Program(graph, [root, other], Texts()).leaves) == {"same", "a", "c"}


@pytest.mark.parametrize("value", [2.0, True, "x"])
def test_a_constant_can_replace_a_leaf(value: bool | float | str) -> None:
    def leaf(path: Path) -> str | Constant:
        return Constant(value) if path[-1] == "b" else str(path[-1])

    graph, expression = Graph(), ENVIRONMENT.compile("has(m.b) && (m.a == m.b || m.b == m.c)")
    table = Table([{"a": a, "c": c, "b": value} for a in (value, 1.0, None) for c in (value, "y", None)])
    root = graph.add(expression, leaf)
    assert root is not None
    results = table.run(graph, [root])
    assert [value_at(results.column(root), row, table.texts) for row in range(9)] == table.by_cel(expression)
    assert Program(graph, [root], table.texts).leaves == ("a", "c")


def test_an_expression_without_leaves_has_its_value_in_every_row() -> None:
    graph = Graph()
    root = graph.add(ENVIRONMENT.compile("1 + 2 > 2"), by_path)
    assert root is not None
    results = Program(graph, [root], Texts()).run(np.zeros((0, 3)), None)
    assert results.truths([root])[0].tolist() == [[True] * 3]


@pytest.mark.parametrize("source", ["m.a", "d", "true", "2.5", "'x'", "!m.a"])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_results_have_a_value_for_each_row(source: str, count: int) -> None:
    table, graph = Table([{"a": True, "d": 1.0}] * count), Graph()
    root = graph.add(ENVIRONMENT.compile(source), by_path)
    assert root is not None
    results = table.run(graph, [root, graph.truth(root)])
    assert results.column(root).values.shape == (count,)
    assert [part.shape for part in results.truths([graph.truth(root)] * 2)] == [(2, count)] * 2


def test_has_distinguishes_a_missing_field_from_a_missing_parent() -> None:
    expression = ENVIRONMENT.compile("has(m.a.b)")
    messages: list[object] = [{"a": {"b": 1.0}}, {"a": {"b": [2.0]}}, {"a": {}}, {"a": {"b": None}}, {"a": 1.0}, {}]
    leaves = [1.0, [2.0], MISSING, None, NOWHERE, NOWHERE]
    graph, texts = Graph(), Texts()
    root = graph.add(expression, lambda path: path)
    assert root is not None
    column = column_of(leaves, texts)
    assert column.tags is not None
    results = Program(graph, [root], texts).run(column.values[np.newaxis], column.tags[np.newaxis])
    assert results.cel_rows(root) is None
    found = [value_at(results.column(root), row, texts) for row in range(len(leaves))]
    assert found == [expression.evaluate_or_unknown({"m": message}) for message in messages]
    assert found == [True, True, False, False, UNKNOWN, UNKNOWN]


FOREIGN_ROWS = [
    ("m.a < m.b", {"a": "x", "b": "y"}, True),
    ("m.a + m.b", {"a": "x", "b": "y"}, True),
    ("m.a - m.b", {"a": "x", "b": "y"}, False),
    ("m.a < m.b", {"a": "x", "b": 1.0}, False),
    ("m.a < m.b", {"a": True, "b": False}, False),
    ("m.a + 1", {"a": "x"}, False),
    ("m.a == m.b", {"a": [1.0], "b": 1.0}, True),
    ("m.a == 1", {"a": 2**60}, True),
    ("m.a in ['x']", {"a": b"x"}, True),
    ("m.a == 'x'", {"a": "\ud800"}, True),
    ("m.a > 1", {"a": 2.0, "b": [1.0]}, False),
    ("has(m.a)", {"a": [1.0]}, False),
    ("has(m.a) && m.a > 1", {"a": b"x"}, True),
    ("m.a", {"a": [1.0]}, False),
    ("d > 1", {"d": True}, True),
    ("d > 1", {"d": None}, False),
    ("s == 'x'", {"s": 1.0}, True),
    ("m.c ? m.a : 1", {"c": True, "a": [1.0]}, True),
    ("(m.c ? 'x' : m.a) < m.b", {"c": True, "b": "y"}, True),
]


@pytest.mark.parametrize(("source", "row", "expected"), FOREIGN_ROWS)
def test_only_rows_that_columns_cannot_decide_are_foreign(source: str, row: Row, expected: bool) -> None:
    plain = dict.fromkeys(("a", "b", "c"), 1.0)
    table, graph = Table([plain, row, {}]), Graph()
    root = graph.add(ENVIRONMENT.compile(source), by_path)
    assert root is not None
    cel_rows = table.run(graph, [root]).cel_rows(root)
    assert ([False] * 3 if cel_rows is None else cel_rows.tolist()) == [False, expected, False]


def test_a_foreign_value_of_a_leaf_with_two_names_is_foreign_under_both() -> None:
    table, graph = Table([{"x": 1.0}, {"x": 2**60}, {"x": "y"}]), Graph()
    roots = [graph.add(ENVIRONMENT.compile(source), lambda _: "x") for source in ("m.a > 1", "d > 1", "m.a > m.b")]
    results = table.run(graph, [root for root in roots if root is not None])
    cel_rows = [results.cel_rows(root) for root in roots if root is not None]
    assert [None if each is None else each.tolist() for each in cel_rows] == [
        [False, True, False],
        [False, True, True],
        [False, True, True],
    ]


def test_results_outlive_later_runs_of_their_program() -> None:
    graph = Graph()
    root = graph.add(ENVIRONMENT.compile("m.a + 1"), by_path)
    assert root is not None
    program = Program(graph, [root], Texts())
    first = program.run(np.full((1, 1000), 1.0), None)
    column = program.run(np.full((1, 1000), 2.0), None).column(root)  # its Results are gone, not what was taken out
    for number in range(5):
        program.run(np.full((1, 1000), float(number)), None)
    assert first.column(root).values.tolist() == [2.0] * 1000
    assert column.values.tolist() == [3.0] * 1000


def test_a_program_is_unchanged_when_its_graph_grows() -> None:
    graph = Graph()
    root = graph.add(ENVIRONMENT.compile("m.a > 1"), by_path)
    assert root is not None
    program = Program(graph, [root], Texts())
    graph.add(ENVIRONMENT.compile("m.b > 1 || m.a > 1"), by_path)
    assert program.run(np.array([[2.0]]), None).truths([root])[0].tolist() == [[True]]


@given(st.lists(ANYTHING))
def test_columns_return_the_values_they_are_made_of(values: list[object]) -> None:
    texts, expression = Texts(), ENVIRONMENT.compile("m.a")
    column = column_of(values, texts)
    for row, value in enumerate(values):
        if column.tags is not None and column.tags[row] == Tag.OTHER:
            assert value_at(column, row, texts) is value
        else:
            assert same(value_at(column, row, texts), expression.evaluate_or_unknown({"m": {"a": value}}))


@pytest.mark.parametrize("value", [2**53, 2**53 + 1, -(2**53) - 1, 2**64, 10**400, -(10**400), 2**63])
def test_columns_of_integers_keep_each_digit(value: int) -> None:
    column = column_of([1, value, None], Texts())
    expected = ENVIRONMENT.compile("m").evaluate_or_unknown({"m": value})
    assert same(value_at(column, 1, Texts()), expected)


def test_columns_of_only_doubles_have_no_tags() -> None:
    assert column_of([1.0, math.inf], Texts()).tags is None
    column = column_of(
        [1.0, math.nan, UNKNOWN, MISSING, NOWHERE, np.float32(0.5), np.int64(3), np.bool_(True)], Texts()
    )
    assert column.tags is not None
    assert column.tags.tolist() == [Tag.NUMBER, *[Tag.ABSENT] * 3, Tag.UNREACHABLE, *[Tag.NUMBER] * 2, Tag.BOOLEAN]


def test_codes_of_texts_stay() -> None:
    texts = Texts()
    codes = [texts.code(text) for text in ("x", "y", "a\0b", "a␀b", "x")]
    assert codes == [0, 1, 2, 2, 0]
    assert [texts.text(code) for code in codes] == ["x", "y", "a␀b", "a␀b", "x"]
    assert value_at(Column(np.array([1.0]), np.array([Tag.TEXT], np.uint8)), 0, texts) == "y"


SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 180.0, -180.0, 360.0, 540.0, np.inf, -np.inf, 5e-324, 1e308, -1e308, 1e-308])


def doubles(seed: int, shape: tuple[int, int]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Of all magnitudes and of the usual ones, without NaN."""
    generator = np.random.default_rng(seed)
    bits = generator.integers(0, 2**64 - 1, shape, np.uint64, endpoint=True).view(np.float64)
    usual, special = generator.normal(0, 300, shape), generator.choice(SPECIAL, shape)
    found = np.choose(generator.integers(0, 3, shape), [bits, usual, special])
    return np.where(np.isnan(found), 1.5, found)


@pytest.mark.parametrize("key", sorted(SCALAR), ids=lambda key: f"{key[0]}{key[1]}")
@given(seed=st.integers(0, 2**32))
@settings(max_examples=10, deadline=None)
def test_functions_give_the_same_doubles_over_columns(key: tuple[str, int], seed: int) -> None:
    _, count = key
    rows = doubles(seed, (count, 300))
    wanted = np.random.default_rng(seed).random((1, 300)) < 0.9
    with np.errstate(all="ignore"):
        results, answered = calculate(key, [row[np.newaxis] for row in rows], wanted)
    for row in np.flatnonzero(wanted[0]):
        try:
            expected: object = SCALAR[key](*rows[:, row].tolist())
        except (ValueError, ArithmeticError):
            expected = UNKNOWN
        found: object = float(results[0, row]) if answered is None or answered[0, row] else UNKNOWN
        assert same(found, expected) or (found != found and expected != expected), rows[:, row]  # noqa: PLR0124


def test_vectorised_functions_are_functions_of_expressions() -> None:
    assert set(VECTORISED) <= set(SCALAR)


def test_expressions_alone_do_not_import_numpy() -> None:
    code = "import sys, wayside.expressions; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
