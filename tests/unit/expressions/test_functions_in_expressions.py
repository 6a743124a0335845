"""Functions in expressions: how values reach them, what is refused when compiling, what is unknown, and their docs."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.guides import guide
from wayside.expressions import UNKNOWN, CelType, Environment, EvaluationError, ExpressionError, Reason
from wayside.expressions.__main__ import tables, with_tables
from wayside.expressions.functions import FUNCTIONS

ENVIRONMENT = Environment(
    {"msg": CelType.DYN, "area": CelType.DYN, "streams": CelType.LIST, "a": CelType.MAP, "x": CelType.DOUBLE}
)
SQUARE = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]


def evaluate(source: str, **values: object) -> object:
    return ENVIRONMENT.compile(source).evaluate_or_unknown(values)


def why_unknown(source: str, **values: object) -> tuple[Reason, str]:
    reported: list[tuple[Reason, str]] = []
    result = ENVIRONMENT.compile(source).evaluate_or_unknown(values, lambda *reason: reported.append(reason))
    assert result is UNKNOWN
    (reason,) = reported
    return reason


def test_a_polygon_may_be_written_or_come_from_a_value_in_any_shape() -> None:
    for polygon in (SQUARE, np.array(SQUARE), [{"x": x, "y": y} for x, y in SQUARE], tuple(map(tuple, SQUARE))):
        assert evaluate("inside(1, 3.5, area)", area=polygon) is True
        assert evaluate("inside(5, 3.5, msg.area)", msg={"area": polygon}) is False
    assert evaluate("inside(1, x, [[0, 0], [4, 0], [4, 4]])", x=0.5) is True
    assert evaluate("inside(1, 2, msg.areas[1])", msg={"areas": [[], SQUARE]}) is True
    assert evaluate("msg.areas.exists(p, inside(1, 2, p))", msg={"areas": [[[0, 0], [1, 0], [0, 1]], SQUARE]}) is True


def test_values_used_only_as_arguments_are_not_converted() -> None:
    untouched = [{"x": 1.0, "y": 0.0, "no data": object()}, {"x": 9.0, "y": 0.0}]
    assert evaluate("size(msg.items)", msg={"items": untouched}) is UNKNOWN
    assert evaluate("countUnmatched(msg.items, [[1, 0]], 0.5)", msg={"items": untouched}) == 1.0
    places = [{"x": 1.0, "y": 0.0}, {"x": 9.0, "y": 0.0}]
    assert evaluate("size(unmatched(a.seen, msg.seen, 1)) == 1", a={"seen": places}, msg={"seen": places[:1]}) is True
    assert evaluate("size(msg.o) + countUnmatched(msg.o, msg.o, 1)", msg={"o": places}) == 2.0
    assert evaluate("msg.o[0].x + nearest(msg.o, 0, 0)", msg={"o": places}) == 2.0
    assert evaluate('size(streams) > 1 && "b" in streams', streams=["a", "b"]) is True


def test_bytes_reach_expressions_through_functions_only() -> None:
    image = bytes(10**6)
    msg = {"data": image, "mask": b"\0\1\0", "parts": [{"d": b"\0"}, {"d": b"\1"}], "none": None}
    assert evaluate("allZero(msg.data) && !allZero(msg.mask)", msg=msg) is True
    assert evaluate("byteCount(msg.data)", msg=msg) == 1e6
    assert evaluate("has(msg.data) && !has(msg.none)", msg=msg) is True
    assert evaluate("msg.parts.map(p, allZero(p.d))", msg=msg) == [True, False]
    assert evaluate("msg.parts.filter(p, allZero(p.d))", msg=msg) == [{"d": b"\0"}]
    assert evaluate("msg.data", msg=msg) == image
    assert evaluate("numberAt(msg, 1, 'u16be')", msg=b"\0\1\2") == 258.0
    assert evaluate("utf8(msg)", msg="grün".encode()) == "grün"
    assert evaluate("msg.data > 3", msg=msg) is UNKNOWN  # and not true, whatever stands for them within
    reason, text = why_unknown("size(msg.mask) > 2", msg=msg)
    assert reason is Reason.ERROR
    assert "byteCount" in text
    assert evaluate("checksum(msg.none) == 1", msg=msg) is UNKNOWN


def test_the_checksum_is_crc_32_and_its_check_value_is_right() -> None:
    assert evaluate("checksum(msg)", msg=b"123456789") == float(0xCBF43926)  # the check value of CRC-32/ISO-HDLC
    assert evaluate("checksum(msg)", msg=b"") == 0.0


@pytest.mark.parametrize(
    ("source", "column", "message", "hint"),
    [
        ("x > inside(1, 2)", 11, "wrong number of arguments for `inside`", "(x, y, polygon): number, number, list"),
        ("inside('1', 2, area)", 7, "`inside` does not take (string, double, dyn)", "number, number, list"),
        ("1 + allZero(area)", 3, "`+` does not take (double, bool)", None),
        ("timeToColision(1, 2) < 3", 15, "there is no function `timeToColision`", "did you mean `timeToCollision`?"),
        ("wgs84Distance(1, 2, 3, true)", 14, "`wgs84Distance` does not take (double, double, double, bool)", "it"),
        ("yaw(1)", 4, "`yaw` does not take (double)", "yaw(quaternion) or yaw(x, y, z, w)"),
    ],
)  # fmt: skip
def test_a_wrong_call_does_not_compile(source: str, column: int, message: str, hint: str | None) -> None:
    with pytest.raises(ExpressionError) as caught:
        ENVIRONMENT.compile(source)
    assert (caught.value.message, caught.value.column) == (message, column)
    assert (hint or "") in (caught.value.hint or "")


@pytest.mark.parametrize(
    ("source", "values", "reason", "text"),
    [
        ("inside(1, 2, area)", {"area": [[0, 0], [1, 1]]}, Reason.ERROR, "three corners or more; got 2"),
        ("inside(1, 2, area)", {"area": [[0, 0], [1, None], [2, 2]]}, Reason.ABSENT, "no value for polygon[1][1]"),
        ("inside(1, 2, area)", {"area": "here"}, Reason.ERROR, "number, list; got number, number, string"),
        ("inside(msg.o, 2, area)", {"area": SQUARE, "msg": {"o": [1]}}, Reason.ERROR, "; got list, map or bytes"),
        ("inside(1, 2, area)", {"area": {"x": 1}}, Reason.ERROR, "polygon must be a list"),
        ("inside(msg.x, 2, area)", {"area": SQUARE, "msg": {}}, Reason.ABSENT, "no key"),
        ("inside(msg.x, 2, area)", {"area": SQUARE, "msg": {"x": float("nan")}}, Reason.ABSENT, "no key"),
        ("inside(0.0 / 0.0, 2, area)", {"area": SQUARE}, Reason.ABSENT, "no value for x of inside"),
        ("nearest(msg.o, 0, 0)", {"msg": {"o": [{"id": 1.0}]}}, Reason.ABSENT, "no value for items[0].x"),
        ("nearest(msg.o, 0, 0, 'p.q')", {"msg": {"o": [{"p": {}}]}}, Reason.ABSENT, "no value for p.q of items[0]"),
        ("nearest(msg.o, 0, 0)", {"msg": {"o": [{"x": "1", "y": 2}]}}, Reason.ERROR, "items[0].x must be a number"),
        ("minimum(msg.o)", {"msg": {"o": [None, float("nan")]}}, Reason.ABSENT, "no item of the list is known"),
        ("sqrt(x)", {"x": -1.0}, Reason.ERROR, "needs a number of 0 or more"),
        ("yaw(msg.q)", {"msg": {"q": {"x": 0, "y": 0, "z": 0, "w": 0}}}, Reason.ERROR, "must be finite and above 0"),
        ("numberAt(msg, 2, 'u16le')", {"msg": b"\0\1\2"}, Reason.ABSENT, "bytes 2 to 3: there are 3"),
        ("numberAt(msg, 2, 'u24')", {"msg": b"\0\1\2"}, Reason.ERROR, "format must be one of u8"),
        ("utf8(msg)", {"msg": b"\xff"}, Reason.ERROR, "not valid UTF-8"),
        ("allZero(msg)", {"msg": [0.0]}, Reason.ERROR, "data must be bytes"),
        ("wgs84Distance(91, 0, 0, 0)", {}, Reason.ERROR, "latitude must be between -90 and 90"),
    ],
)  # fmt: skip
def test_functions_without_a_result_are_unknown_with_a_reason(
    source: str, values: dict[str, object], reason: Reason, text: str
) -> None:
    found, message = why_unknown(source, **values)
    assert (found, text in message) == (reason, True), message
    assert evaluate(f"{source} == {source} || true", **values) is True
    with pytest.raises(EvaluationError):
        ENVIRONMENT.compile(source).evaluate(values)


def test_records_of_decoded_messages_are_maps() -> None:
    @dataclasses.dataclass
    class Quaternion:
        x: float
        y: float
        z: float
        w: float

    assert evaluate("yaw(msg.q)", msg={"q": Quaternion(0.0, 0.0, 1.0, 0.0)}) == pytest.approx(np.pi)
    assert evaluate("yaw(0, 0, 1, 0)") == pytest.approx(np.pi)
    assert evaluate("nearest(msg.o, 0, 3)", msg={"o": [Quaternion(4.0, 0.0, 0.0, 0.0)]}) == 5.0


def calls() -> list[tuple[str, int]]:
    """Every way to call every function, with arguments from a list."""
    ways = [(name, len(way.parameters)) for name, function in FUNCTIONS.items() for way in function.signatures]
    return [(f"{name}({', '.join(f'args[{i}]' for i in range(count))})", count) for name, count in ways]


ARGUMENTS = Environment({"args": CelType.DYN})
numbers = st.sampled_from([0.0, -0.0, 1e308, -1e308, 5e-324, 2.0**53]) | st.floats() | st.integers(-(2**70), 2**70)
texts = st.sampled_from(["", "u8", "f64be", "x", "a.b", "\0", "position"]) | st.text(max_size=3)
places = st.dictionaries(
    st.sampled_from(["x", "y", "z", "w", "position", "pose", "a"]), numbers | st.none(), max_size=5
)
scalars = st.none() | st.booleans() | numbers | texts | st.binary(max_size=9) | places
anything = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=3), max_leaves=12
)
likely = st.lists(st.tuples(numbers, numbers).map(list) | places, max_size=5) | numbers | anything


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(calls()), st.lists(likely, min_size=5, max_size=5))
def test_any_arguments_give_a_value_or_a_reason(call: tuple[str, int], arguments: list[Any]) -> None:
    source, count = call
    reported: list[str] = []
    result = ARGUMENTS.compile(source).evaluate_or_unknown(
        {"args": arguments[:count]}, lambda reason, text: reported.append(text)
    )
    assert (result is UNKNOWN) == (len(reported) == 1)
    assert not any("Error" in text or "Traceback" in text for text in reported), reported
    if result is not UNKNOWN:
        assert isinstance(result, float | bool | str | list)


def test_the_tables_in_the_guides_match_the_code() -> None:
    for page, of_page in tables().items():
        text = guide(page.removesuffix(".md"))
        assert with_tables(text, of_page) == text, "run `make crds`"
    with pytest.raises(ValueError, match="there is no table with the first column function"):
        with_tables("# A page\n", tables()["rules.md"])
