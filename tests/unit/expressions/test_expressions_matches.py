"""`matches` takes a literal pattern of bounded size and a text of bounded length, so one match ends soon."""

from __future__ import annotations

import pytest

from application_manager.core.claims.parameters import mismatch, pattern_problem
from wayside.expressions import CelType, Environment, EvaluationError, ExpressionError
from wayside.expressions.bounds import LARGEST_PATTERN, LONGEST_INPUT, pattern_size

ENVIRONMENT = Environment({"s": CelType.STRING, "msg": CelType.DYN, "items": CelType.LIST})


@pytest.mark.parametrize(
    "source",
    [
        's.matches("^a+$")',
        'matches(s, "^a+$")',
        'msg.name.matches("^a+$")',
        'items.exists(each, each.matches("^a+$"))',
        '(s + "a").matches("^a+$")',
        "s.matches(r'^[a]{1,63}$')",
    ],
)
def test_a_literal_pattern_matches_and_a_long_string_is_unknown(source: str) -> None:
    expression = ENVIRONMENT.compile(source, result=CelType.BOOL)

    def outcome(text: str) -> object:
        return expression.evaluate({"s": text, "msg": {"name": text}, "items": [text]})

    assert outcome("aaa") is True
    assert outcome("b") is False
    with pytest.raises(EvaluationError, match=f"at most {LONGEST_INPUT} bytes; got"):
        outcome("é" * LONGEST_INPUT)


@pytest.mark.parametrize(
    ("source", "logged"),
    [
        ("s.matches(s)", "line 1, column 3: the pattern of `matches` must be a literal string"),
        ("true || s.matches(msg.pattern)", "line 1, column 11: the pattern of `matches` must be a literal string"),
        ('s.matches("a" + "b")', "the pattern of `matches` must be a literal string"),
        ('items.map(p, s.matches(p))[0]', "the pattern of `matches` must be a literal string"),
        ('s.matches("([ab]*a[ab]{50}){30}z")', "must take at most 1000 steps"),
    ],
)  # fmt: skip
def test_a_pattern_that_is_not_literal_or_is_too_large_does_not_compile(source: str, logged: str) -> None:
    with pytest.raises(ExpressionError) as refused:
        ENVIRONMENT.compile(source)
    assert logged in str(refused.value)


@pytest.mark.parametrize(
    ("pattern", "least"),
    [
        ("a{1000}", 1000),
        ("(a{30}){30}", 900),
        ("((a|b|c){10}){10}", 300),
        (r"\pL{10}", 3000),
        (r"[\pL]{10}", 3000),
        (r"(?:\pL){10}", 3000),
        ("(?P<name>a{100}){10}", 1000),
        (r"\Qaaaa\E{100}", 100),
        ("[^a]{100}", 1000),
        (".{100}", 1000),
    ],
)
def test_the_size_of_a_pattern_counts_repetitions(pattern: str, least: int) -> None:
    assert pattern_size(pattern) >= least


@pytest.mark.parametrize(
    "pattern",
    [
        "^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?$",
        r"^(\d{1,3}\.){3}\d{1,3}$",
        "^[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}$",
        "^(car|bus|truck|tram|bicycle)_[0-9]{1,6}$",
        "",
        "(",
        "[",
        "a{",
        "\\",
    ],
)
def test_usual_and_invalid_patterns_are_within_the_bound(pattern: str) -> None:
    assert pattern_size(pattern) <= LARGEST_PATTERN


def test_the_patterns_of_parameters_have_the_same_bounds() -> None:
    assert "takes 30003 steps, more than 1000" in (pattern_problem(r"\pL{100}") or "")
    assert "a parameter with a pattern may have at most 4096" in (mismatch("a+", "a" * 5000) or "")
    assert mismatch('^["\\\\]+$', '"\\') is None
    assert mismatch("^[ä😀]+$", "ä😀") is None
