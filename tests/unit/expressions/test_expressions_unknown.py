"""Kleene's logic: an expression is unknown exactly where what is known does not decide it."""

import itertools
import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wayside.expressions import UNKNOWN, CelType, Environment, Reason, Unknown

ENVIRONMENT = Environment(dict.fromkeys(("p", "q", "r", "msg"), CelType.DYN) | {"d": CelType.DOUBLE, "l": CelType.LIST})
Truth = bool | None
TRUTHS: tuple[Truth, ...] = (True, False, None)


def evaluate(source: str, **values: object) -> object:
    return ENVIRONMENT.compile(source).evaluate_or_unknown(values)


def reasons(source: str, **values: object) -> list[Reason]:
    reported: list[Reason] = []
    result = ENVIRONMENT.compile(source).evaluate_or_unknown(values, lambda reason, _: reported.append(reason))
    assert result is UNKNOWN
    return reported


def conjunction(a: Truth, b: Truth) -> Truth:
    return False if a is False or b is False else None if a is None or b is None else True


def negation(a: Truth) -> Truth:
    return None if a is None else not a


def disjunction(a: Truth, b: Truth) -> Truth:
    return negation(conjunction(negation(a), negation(b)))


def absent(name: str, truth: Truth) -> dict[str, object]:
    return {} if truth is None else {name: truth}


@pytest.mark.parametrize(("a", "b"), list(itertools.product(TRUTHS, TRUTHS)))
@pytest.mark.parametrize("unknown", [None, float("nan"), ...], ids=["null", "NaN", "absent"])
def test_truth_tables(a: Truth, b: Truth, unknown: object) -> None:
    values = {k: unknown if v is None else v for k, v in (("p", a), ("q", b)) if v is not None or unknown is not ...}
    nested = {"msg": values}
    for names, given_values in (("p q", values), ("msg.p msg.q", nested)):
        p, q = names.split()
        for source, expected in (
            (f"{p} && {q}", conjunction(a, b)),
            (f"{p} || {q}", disjunction(a, b)),
            (f"!{p}", negation(a)),
            (f"{p} ? {q} : true", None if a is None else b if a else True),
            (f"{p} ? false : {q}", None if a is None else False if a else b),
        ):
            result = evaluate(source, **given_values)
            assert (None if result is UNKNOWN else result) is expected, source


_FORMULA = st.recursive(
    st.sampled_from("pqr"),
    lambda below: (
        st.tuples(st.just("!"), below)
        | st.tuples(st.just("&&"), below, below)
        | st.tuples(st.just("||"), below, below)
        | st.tuples(st.just("?:"), below, below, below)
    ),
    max_leaves=8,
)


def written(formula: object) -> str:
    match formula:
        case ("!", a):
            return f"!({written(a)})"
        case ("?:", a, b, c):
            return f"(({written(a)}) ? ({written(b)}) : ({written(c)}))"
        case (operator, a, b):
            return f"(({written(a)}) {operator} ({written(b)}))"
    return f"({formula} > 0)"


def meaning(formula: object, truths: dict[str, Truth]) -> Truth:
    match formula:
        case ("!", a):
            return negation(meaning(a, truths))
        case ("&&", a, b):
            return conjunction(meaning(a, truths), meaning(b, truths))
        case ("||", a, b):
            return disjunction(meaning(a, truths), meaning(b, truths))
        case ("?:", a, b, c):
            condition = meaning(a, truths)
            return None if condition is None else meaning(b if condition else c, truths)
    return truths[str(formula)]


@given(_FORMULA, st.fixed_dictionaries({name: st.sampled_from(TRUTHS) for name in "pqr"}), st.sampled_from(["", "NaN"]))
@settings(max_examples=200)
def test_any_formula_over_comparisons_is_kleene(formula: object, truths: dict[str, Truth], how: str) -> None:
    values = {
        name: (1.0 if truth else -1.0) if truth is not None else float("nan")
        for name, truth in truths.items()
        if truth is not None or how
    }
    result = evaluate(written(formula), **values)
    assert (None if result is UNKNOWN else result) is meaning(formula, truths)


def test_nan_deep_inside_a_message_is_unknown_not_false() -> None:
    message = {"pose": {"x": float("nan"), "y": 1.0}}
    assert evaluate("msg.pose.x > 3", msg=message) is UNKNOWN
    assert evaluate("!(msg.pose.x > 3)", msg=message) is UNKNOWN
    assert evaluate("msg.pose.x == 3", msg=message) is UNKNOWN
    assert evaluate("msg.pose.y < 3", msg=message) is True
    assert evaluate("has(msg.pose.x)", msg=message) is False


def test_nan_in_a_list_keeps_indices_and_other_elements_known() -> None:
    ranges = [float("nan"), 2.0, None, 4.0]
    assert evaluate("l[1] == 2 && l[3] == 4 && size(l) == 4", l=ranges) is True
    assert evaluate("l[0] > 1", l=ranges) is UNKNOWN
    assert evaluate("l.exists(x, x > 3)", l=ranges) is True
    assert evaluate("l.exists(x, x > 5)", l=ranges) is UNKNOWN
    assert evaluate("l.all(x, x > 3)", l=ranges) is False
    assert evaluate("l.all(x, x > 1)", l=ranges) is UNKNOWN


@pytest.mark.parametrize(
    ("source", "values"),
    [
        ("p", {}),
        ("p", {"p": None}),
        ("p > 3", {"p": float("nan")}),
        ("msg.a.b", {"msg": {"a": {}}}),
        ("msg.a.b > 3", {"msg": {"a": None}}),
        ("l[3]", {"l": [1]}),
        ("l[0] > 1", {"l": [None]}),
        ("d - d + 0.0 / 0.0", {"d": 1.0}),
        ("msg.data > 3", {"msg": {"data": b"\0"}}),
    ],
)
def test_a_missing_input_is_distinguished_from_a_fault(source: str, values: dict[str, object]) -> None:
    assert reasons(source, **values) == [Reason.ABSENT]


@pytest.mark.parametrize(
    ("source", "values"),
    [
        ("p > 3", {"p": "fast"}),
        ("p.x", {"p": 3}),
        ("double(int(p) % int(0)) == 1", {"p": 3}),
        ("p.startsWith('a')", {"p": 3}),
        ("l.all(x, x > 0)", {"l": [1.0] * 11_000}),
        ("p", {"p": object()}),
        ("p == 'x'", {"p": "\ud800"}),
        ("d > 1", {"d": "far"}),
    ],
)
def test_a_fault_of_the_expression_is_distinguished_from_an_absent_input(
    source: str, values: dict[str, object]
) -> None:
    assert reasons(source, **values) == [Reason.ERROR]


def test_a_condition_that_is_not_boolean_is_a_fault() -> None:
    expression = ENVIRONMENT.compile("p", result=CelType.BOOL)
    reported: list[tuple[Reason, str]] = []
    assert expression.evaluate_or_unknown({"p": 3}, lambda *why: reported.append(why)) is UNKNOWN
    assert reported == [(Reason.ERROR, "must be a boolean; got a number")]
    assert expression.evaluate_or_unknown({"p": True}) is True


def test_known_values_have_no_reasons() -> None:
    reported: list[object] = []
    assert ENVIRONMENT.compile("d < 3 || p").evaluate_or_unknown({"d": 1.0}, lambda *why: reported.append(why)) is True
    assert reported == []


def test_unknown_is_a_singleton_without_a_truth_value() -> None:
    assert repr(UNKNOWN) == "unknown"
    assert Unknown() is UNKNOWN
    assert pickle.loads(pickle.dumps(UNKNOWN)) is UNKNOWN
    with pytest.raises(TypeError, match="is UNKNOWN"):
        bool(UNKNOWN)
