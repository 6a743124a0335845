"""Compile errors are shown in the author's text, with the remedy."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wayside.expressions import CelType, Environment, ExpressionError

ENVIRONMENT = Environment(
    {"speed": CelType.DYN, "distance": CelType.DOUBLE, "msg": CelType.DYN, "l": CelType.LIST, "braking": CelType.BOOL}
)


def refusal(source: object) -> ExpressionError:
    with pytest.raises(ExpressionError) as caught:
        ENVIRONMENT.compile(source)  # type: ignore[arg-type]
    return caught.value


@pytest.mark.parametrize(
    ("source", "line", "column", "message"),
    [
        ("distance <", 1, 11, "the expression is incomplete"),
        ("size(l) > 2 && 'x' > 3", 1, 20, "`>` does not take (string, double)"),
        ("l[speed + 1] + 2 + size(l) + nothing", 1, 30, "`nothing` is not declared here"),
        ("distance\n  + 3 // 4\n  + nothing", 3, 5, "`nothing` is not declared here"),
        ('"ü𝄞" + nothing', 1, 8, "`nothing` is not declared here"),
        ("3 + nothing.of.this", 1, 5, "`nothing` is not declared here"),
        ("0x1F + 1000 + nothing", 1, 15, "`nothing` is not declared here"),
        ("(braking", 1, 9, "missing `)`"),
        ("braking)", 1, 8, "unexpected `)`"),
        ("msg.near(3)", 1, 9, "there is no function `near`"),
        ("99999999999999999999", 1, 1, "invalid int literal"),
        ("l['a']", 1, 2, "`[]` does not take (list(dyn), string)"),
        ("+".join(["1"] * 100), 1, 1, "the expression is nested too deeply"),
        ("(" * 100 + "1" + ")" * 100, 1, 1, "the expression is nested too deeply"),
    ],
)
def test_errors_are_located_in_the_authors_text(source: str, line: int, column: int, message: str) -> None:
    error = refusal(source)
    assert (error.message, error.line, error.column, error.source) == (message, line, column, source)
    assert str(error).startswith(f"line {line}, column {column}: {message}")


@pytest.mark.parametrize(
    ("source", "hint"),
    [
        ("distence < 5", "did you mean `distance`?"),
        ("spead > 3 && distance < 5", "did you mean `speed`?"),
        ("points", "declared: `braking`, `distance`, `l`, `msg`, `speed`"),
        ("points", "'\"points\"'"),
        ("braking and braking", "`&&`"),
        ("braking or braking", "`||`"),
        ("not braking", "`!`"),
        ("speed = 3", "`==`"),
        ("braking & braking", "`&&`"),
        ("braking | braking", "`||`"),
        ("speed == 'fast", "a string is not closed"),
        ("True", "`true`"),
        ("speed == None", "`null`"),
        ("", "YAML interprets a leading `!`"),
        ("  \n", "YAML interprets a leading `!`"),
        (None, "YAML interprets a leading `!`"),
        (True, 'in quotes: "true"'),
        (5, 'in quotes: "5"'),
        ("distance < 5 m", "remove the unit"),
        ("distance < 5s", "remove the unit"),
        ("distance % 2 == 0", "double(int(a) % int(b))"),
        ("int(distance) % 2 == 0", "double(int(x))"),
        ("braking ? 1 : 'a'", "two values of the same type"),
        ("braking && distance", "takes booleans"),
    ],
)
def test_the_remedy_is_named(source: object, hint: str) -> None:
    error = refusal(source)
    assert error.hint is not None
    assert hint in error.hint
    assert "\n" not in str(error)


def test_all_errors_are_reported_in_the_order_of_the_text() -> None:
    error = refusal("nothing > 3 &&\n nobody < size(none)")
    assert [(each.line, each.column) for each in (error, *error.others)] == [(1, 1), (2, 2), (2, 16)]


@given(st.text(alphabet="ab1.[](){}\"'<>=!&|?:+-*/% \n$speed", max_size=30))
@settings(max_examples=300)
def test_any_text_compiles_or_is_rejected_with_a_position_inside_it(source: str) -> None:
    try:
        expression = ENVIRONMENT.compile(source)
    except ExpressionError as error:
        for each in (error, *error.others):
            assert 1 <= each.line <= source.count("\n") + 1
            assert 1 <= each.column <= len(source.split("\n")[each.line - 1]) + 1
            assert "<input>" not in str(each)
    else:
        assert expression.names <= set(ENVIRONMENT.variables)
