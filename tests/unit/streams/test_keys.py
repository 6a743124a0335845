"""Key patterns subscribe to what they match, and report the place of errors."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from wayside.keys import KeyPattern, KeyPatternError


def test_the_captured_client_is_read_from_the_key() -> None:
    pattern = KeyPattern.parse("vehicles/${client:*}/pose")
    assert pattern.expression == "vehicles/*/pose"
    assert pattern.captures == ("client",)
    assert pattern.match("vehicles/car:7.a/pose") == {"client": "car:7.a"}


@pytest.mark.parametrize("key", ["vehicles/pose", "vehicles/a/b/pose", "vehicles/a/pose/x", "x/vehicles/a/pose", ""])
def test_keys_of_another_shape_do_not_match(key: str) -> None:
    assert KeyPattern.parse("vehicles/${client:*}/pose").match(key) is None


@pytest.mark.parametrize(
    ("pattern", "key", "captures"),
    [
        ("a/${x:**}/b", "a/b", {"x": ""}),
        ("a/${x:**}/b", "a/1/2/b", {"x": "1/2"}),
        ("${x:**}/b", "b", {"x": ""}),
        ("a/${x:**}", "a", {"x": ""}),
        ("${x:**}", "a/b", {"x": "a/b"}),
        ("${x:**}/${y:**}", "a/b/c", {"x": "a/b/c", "y": ""}),
        ("${x:*/**}/b", "a/c/b", {"x": "a/c"}),
        ("a/${client:car$*}/b", "a/car7/b", {"client": "car7"}),
        ("a/${client:car$*}/b", "a/bus7/b", None),
        ("a/${role:roadside}/${client:*}", "a/roadside/rsu-1", {"role": "roadside", "client": "rsu-1"}),
        ("a/*/${client:*}", "a/@hidden/c", None),
        ("a/${client:*}/$*", "a/c/x", {"client": "c"}),
        ("odom", "odom", {}),
        ("a.b", "axb", None),
    ],
)
def test_captures_are_as_in_zenohs_key_format(pattern: str, key: str, captures: dict[str, str] | None) -> None:
    assert KeyPattern.parse(pattern).match(key) == captures


@pytest.mark.parametrize(
    ("pattern", "column", "words"),
    [
        ("", 1, "empty"),
        ("/a", 2, "the pattern has two slashes in a row: remove one"),
        ("a//b", 3, "the pattern has two slashes in a row: remove one"),
        ("a/", 3, "the key ends with a slash: remove it"),
        ("a/${client:*", 3, "not closed"),
        ("a/${client}/b", 3, "${client:*}"),
        ("a/${client:}/b", 3, "${client:*}"),
        ("a/${1x:*}", 5, "not a name"),
        ("a/car-${client:*}", 3, "whole chunks"),
        ("a/${client:*}x", 3, "whole chunks"),
        ("a/${client:**}", 3, "one chunk"),
        ("a/${client:x/*}", 3, "one chunk"),
        ("a/${x:*}/${x:*}", 10, "twice"),
        ("a/${x:car*}", 7, "$*"),
        ("a/b?c", 3, "'?'"),
        ("a/b#c", 3, "'#'"),
    ],
)
def test_an_error_names_the_column_and_the_remedy(pattern: str, column: int, words: str) -> None:
    with pytest.raises(KeyPatternError) as caught:
        KeyPattern.parse(pattern)
    assert f"column {column}:" in str(caught.value)
    assert words in str(caught.value)
    assert caught.value.column == column


chunks = st.sampled_from(["a", "b", "ab", "@a"])
wild = st.sampled_from(["a", "b", "a$*", "*", "**", "${x:*}", "${y:**}", "${z:a$*}"])


@given(st.lists(wild, min_size=1, max_size=5, unique=True), st.lists(chunks, min_size=1, max_size=5))
def test_a_key_matches_exactly_if_zenoh_would_deliver_it(parts: list[str], key: list[str]) -> None:
    pattern = KeyPattern.parse("/".join(parts))
    expression = zenoh.KeyExpr.autocanonize(pattern.expression)
    assert (pattern.match("/".join(key)) is not None) == expression.intersects("/".join(key))
