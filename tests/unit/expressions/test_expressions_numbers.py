"""Numbers are doubles: what an author writes as integers computes as doubles, and errors keep their places."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wayside.expressions import CelType, Environment, EvaluationError, ExpressionError
from wayside.expressions.lexer import TokenKind, tokens
from wayside.expressions.numbers import MAX_EXACT, doubled

VARIABLES = {
    "d": CelType.DOUBLE,
    "x": CelType.DYN,
    "m": CelType.MAP,
    "l": CelType.LIST,
    "i": CelType.DOUBLE,
    "s": CelType.STRING,
}
ENVIRONMENT = Environment(VARIABLES)
VALUES = {"d": 3.0, "x": {"l": [10, 20, 30], "n": 5, "1": "one"}, "m": {"a": 1}, "l": [1, 2, 3], "i": 1, "s": "wayside"}


@pytest.mark.parametrize(
    ("source", "rewritten"),
    [
        ("d < 150", "d < 150.0"),
        ("-3 + 0xFF", "-3.0 + 255.0"),
        ("007 + .5 + 1e3 + 2.5e-1", "7.0 + .5 + 1e3 + 2.5e-1"),
        ("l[0] + l[-1]", "l[0] + l[-1]"),
        ("l[i + 1]", "l[dyn(i + 1.0)]"),
        ('m["a"]', 'm["a"]'),
        ("[1, 2][0]", "[1.0, 2.0][0]"),
        ("d in [1, 2]", "d in [1.0, 2.0]"),
        ("f(1)[2].g(3)", "f(1.0)[2].g(3.0)"),
        ("size(l) / 2", "double(size(l)) / 2.0"),
        ("l.size() > 1", "double(l.size()) > 1.0"),
        ("!x.l[0].f(1).size()", "!double(x.l[0].f(1.0).size())"),
        ("(l + l).size() + [1].size()", "double((l + l).size()) + double([1.0].size())"),
        ("l[size(l) - 1]", "l[dyn(double(size(l)) - 1.0)]"),
        ("size", "size"),
        ("x.size > 3", "x.size > 3.0"),
        ("int(d) == 3", "double(int(d)) == 3.0"),
        ("double(int(d) % int(2)) == 1", "double(int(d) % int(2.0)) == 1.0"),
        ("int(d) % 2", "int(d) % 2"),
        ("timestamp(0) < timestamp(int(d))", "timestamp(0) < timestamp(int(d))"),
        ("3u + 4U", "3u + 4U"),
        ("x == 9007199254740993", "x == 9007199254740993"),
        ("x1 + d2", "x1 + d2"),
        ("1 // 2 and 3", "1.0 // 2 and 3"),
        ("// 2\n1", "// 2\n1.0"),
        (".d + 1", ".d + 1.0"),
        ("double(.x.size())", "double(double(.x.size()))"),
    ],
)
def test_integers_become_doubles_where_cel_would_refuse_to_mix(source: str, rewritten: str) -> None:
    assert doubled(source).text == rewritten


@pytest.mark.parametrize(
    "text",
    [
        "'a 1 b'",
        '"size(x) 2"',
        r'"\" 3 \\"',
        r"r'\' ",
        'R"4\\n"',
        "b'5'",
        'br"6"',
        "'''7 ' 8'''",
        '"""9\n"10" // 11"""',
        r'"""\""" 12 """',
        '"// 13"',
        "m.`a 14`",
    ],
)
def test_strings_are_left_alone(text: str) -> None:
    assert doubled(text).text == text


@given(st.text())
def test_text_in_quotes_is_never_changed(content: str) -> None:
    quoted = '"' + "".join("\\" + c if c in '"\\' else c for c in content if c not in "\r\n") + '"'
    assert doubled(quoted).text == quoted
    assert [token.kind for token in tokens(quoted)] == [TokenKind.STRING]


@given(st.text(alphabet="ab1 2.3x[](){}\"'`\\/\n,+-%u:?size&|=!<>"))
def test_the_tokens_of_any_text_are_the_text(text: str) -> None:
    assert "".join(token.text for token in tokens(text)) == text


@given(st.text(alphabet="ab12.[]()\"'\n,+-%size", max_size=40))
def test_unchanged_characters_map_to_their_own_position(source: str) -> None:
    result = doubled(source)
    assert len(result.origin) == len(result.text)
    assert list(result.origin) == sorted(result.origin)
    if result.text == source:
        assert list(result.origin) == list(range(len(source)))


@given(st.text(alphabet="ab12.[]\"',+-", max_size=30))
def test_a_second_pass_changes_nothing_but_indices(source: str) -> None:
    once = doubled(source).text
    if "dyn(" not in once:
        assert doubled(once).text == once


_TERM = st.integers(0, 10**6).map(str) | st.sampled_from(
    ["d", "x.n", "l[2]", "x.l[i]", "size(l)", "s.size()", "int(d)"]
)
_MEANING = {"d": 3, "x.n": 5, "l[2]": 3, "x.l[i]": 20, "size(l)": 3, "s.size()": 7, "int(d)": 3}


@given(
    st.lists(st.tuples(st.sampled_from("+-*/"), _TERM), max_size=5),
    _TERM,
    st.sampled_from(["<", ">", "==", "<=", "!="]),
)
@settings(max_examples=150)
def test_arithmetic_is_that_of_doubles(steps: list[tuple[str, str]], first: str, comparison: str) -> None:
    source, expected = first, float(_MEANING.get(first) or int(first))
    for operator, term in steps:
        value = float(_MEANING.get(term) or int(term))
        if operator == "/" and value == 0:
            operator = "+"  # noqa: PLW2901 (0/0 has no float to compare with)
        source = f"({source}) {operator} {term}"
        expected = {
            "+": lambda a, b: a + b,
            "-": lambda a, b: a - b,
            "*": lambda a, b: a * b,
            "/": lambda a, b: a / b,
        }[operator](expected, value)
    assert ENVIRONMENT.compile(source).evaluate(VALUES) == expected
    order = {
        "<": expected < 100,
        ">": expected > 100,
        "==": expected == 100,
        "<=": expected <= 100,
        "!=": expected != 100,
    }
    assert ENVIRONMENT.compile(f"{source} {comparison} 100", result=CelType.BOOL).evaluate(VALUES) is order[comparison]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("x.l[i]", 20.0),
        ("x.l[i + 1]", 30.0),
        ("l[size(l) - 1]", 3.0),
        ("l[int(d / 2)]", 2.0),
        ('x[string(1)] + "!"', "one!"),
        ("x[s == s ? 'n' : 's']", 5.0),
        ("[0, 1, 2].map(k, l[k] * 2)", [2.0, 4.0, 6.0]),
        ("size(l) > 2 && s.size() == 7", True),
        ("3 in l && !(4 in l)", True),
        ("double(int(d) % 2)", 1.0),
        ('timestamp("2026-01-01T10:00:00Z").getHours() / 4', 2.5),
        ('timestamp(60) - timestamp(0) == duration("60s")', True),
        ("string(3) + string(2.5)", "32.5"),
        ("string(int(4294967295.0)) + string(int(7.9))", "42949672957"),
        ("[[1], [2]][1][0]", 2.0),
    ],
)
def test_whole_expressions(source: str, expected: object) -> None:
    assert ENVIRONMENT.compile(source).evaluate(VALUES) == expected


def test_integers_beyond_2_to_53_keep_equality_membership_and_order() -> None:
    def holds(source: str) -> object:
        return ENVIRONMENT.compile(source).evaluate({"x": MAX_EXACT + 1, "d": 4.0})

    assert holds(f"x == {MAX_EXACT + 1} && x != {MAX_EXACT + 3} && x in [1, {MAX_EXACT + 1}]") is True
    assert holds("x > 1.5 && x > d") is True
    assert holds("x") == MAX_EXACT + 1
    with pytest.raises(EvaluationError, match="does not take"):
        holds("x - 1")


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("'its-' + string(x.station)", "its-4294967295"),
        ("string(4711000)", "4711000"),
        ("string(x.share)", "0.25"),
        ("string(x.huge)", "1e+300"),
        ("string(x.exact)", "9007199254740993"),
        ("string(x.name) + string(x.on)", "atrue"),
        ("string(timestamp(0))", "1970-01-01T00:00:00Z"),
        ("string(string(2))", "2"),
    ],
)
def test_whole_numbers_are_written_with_all_their_digits(source: str, text: str) -> None:
    values = {"station": 4294967295.0, "share": 0.25, "huge": 1e300, "exact": 2**53 + 1, "name": "a", "on": True}
    assert ENVIRONMENT.compile(source).evaluate(VALUES | {"x": values}) == text


@pytest.mark.parametrize("value", [b"ab", [1], {"a": 1}])
def test_values_without_text_are_named_by_their_source(value: object) -> None:
    with pytest.raises(EvaluationError, match="`string` does not take a"):
        ENVIRONMENT.compile("string(x)").evaluate(VALUES | {"x": value})
    with pytest.raises(ExpressionError, match="`string` does not take"):
        ENVIRONMENT.compile("string([1])")
