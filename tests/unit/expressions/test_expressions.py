"""An expression is compiled once, knows what it reads, and yields plain data."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wayside.expressions import UNKNOWN, CelType, Environment, EvaluationError, ExpressionError, normalise

ENVIRONMENT = Environment(
    {
        "speed": CelType.DYN,
        "distance": CelType.DOUBLE,
        "msg": CelType.DYN,
        "a": CelType.MAP,
        "l": CelType.LIST,
        "b": CelType.BOOL,
    }
)


def evaluate(source: str, **values: object) -> object:
    return ENVIRONMENT.compile(source).evaluate(values)


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("distance < 150", {"distance"}),
        ("msg.speed > 3", {"msg"}),
        ("l.exists(x, x > speed)", {"l", "speed"}),
        ("l.all(distance, distance > 1)", {"l"}),
        ("l.all(distance, distance > 1) && distance > 3", {"l", "distance"}),
        ('{"speed": 1}.speed == 1', set()),
        ("has(a.b) ? .speed : a[string(distance)]", {"a", "speed", "distance"}),
        ("[distance, {'k': speed}]", {"distance", "speed"}),
        ("type(1) == double", set()),
        ("size(l)", {"l"}),
    ],
)
def test_names_are_the_variables_that_are_read(source: str, names: set[str]) -> None:
    assert ENVIRONMENT.compile(source).names == names


def test_paths_are_the_literal_fields_that_are_read() -> None:
    assert ENVIRONMENT.compile('msg.p[2].x > msg["q"].y && has(a.z) && size(l) > 0').paths == {
        ("msg", "p", 2, "x"),
        ("msg", "q", "y"),
        ("a", "z"),
        ("l",),
    }


def test_compilations_are_cached() -> None:
    assert ENVIRONMENT.compile("distance < 1") is ENVIRONMENT.compile("distance < 1")
    assert ENVIRONMENT.compile("distance < 1", result=CelType.BOOL) is not ENVIRONMENT.compile("distance < 1")


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("null", None),
        ("1", 1.0),
        ("size([1])", 1.0),
        ("[1, 'a', true, null, b'x']", [1.0, "a", True, None, b"x"]),
        ('timestamp("2026-01-01T00:00:00Z")', "2026-01-01T00:00:00Z"),
        ('duration("1500ms")', 1.5),
        ("'\\u00e9'", "é"),
        ('"INVALID_ARGUMENT: divide by zero"', "INVALID_ARGUMENT: divide by zero"),
    ],
)
def test_results_are_plain(source: str, expected: object) -> None:
    result = evaluate(source)
    assert result == expected
    assert type(result) is type(expected)


def test_maps_come_back_sorted_in_every_process() -> None:
    program = (
        "from wayside.expressions import CelType, Environment\n"
        'e = Environment({\'m\': CelType.MAP}).compile(\'{"k": m, "b": 1, "a": 2, "c": 3}\')\n'
        "print(e.evaluate({'m': dict(z=1, y=2, x=3)}))\n"
    )
    outputs = {
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
        for _ in range(3)
    }
    assert outputs == {"{'a': 2.0, 'b': 1.0, 'c': 3.0, 'k': {'x': 3.0, 'y': 2.0, 'z': 1.0}}\n"}


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("speed", "there is no `speed`"),
        ("a.regoin", "there is no `a.regoin`; did you mean `region`?"),
        ("l[3]", "no index 3 in the list$"),
        ("speed + a.region", "there is no `speed`"),
        ("a.region > 3", "`>` cannot compare a string with a number$"),
        ("-a.region", "`-` does not take a string$"),
        ("a.region + l[0]", r"`\+` does not take a string and a number$"),
        ("a.region.hdr.id > 3", "`a.region` is 'north', which has no field `hdr`: correct the path$"),
        ("a.none.id", "`a.none` is null, which has no field `id`: "),
        ("msg.x > 3", "`msg` is a block of 2 bytes, which has no field `x`: read it with numberAt or utf8"),
        ("int", "yields a value of type Type, which is not data"),
    ],
)
def test_failures_report_the_cause(source: str, message: str) -> None:
    with pytest.raises(EvaluationError, match=f"^{message}"):
        evaluate(source, a={"region": "north", "none": None}, msg=b"ab", l=[1])


@dataclasses.dataclass
class Point:
    x: float
    y: float


@dataclasses.dataclass
class Message:
    point: Point
    ranges: object
    stamp: object
    data: bytes = b"\0\1"


def test_decoded_messages_need_no_conversion() -> None:
    msg = Message(Point(1, float("nan")), np.array([1, 2], dtype=np.uint8), np.float32(0.5))
    assert evaluate("msg.point.x + msg.ranges[1] + msg.stamp", msg=msg) == 3.5
    assert evaluate("msg.ranges.map(r, r * 2)", msg=msg) == [2.0, 4.0]
    assert evaluate("[has(msg.point), has(msg.data), has(msg.nothing)]", msg=msg) == [True, True, False]
    assert ENVIRONMENT.compile("msg.point.y > 3").evaluate_or_unknown({"msg": msg}) is UNKNOWN


def test_only_the_read_fields_are_accessed() -> None:
    class Untouchable(dict[str, object]):
        def __getitem__(self, key: str) -> object:
            assert key == "x"
            return 4.0

    message = Untouchable(x=1, spoilt=object())
    assert evaluate("msg.x > 3 && has(msg.x)", msg=message) is True


def test_an_expression_does_not_change_its_inputs() -> None:
    values = {"msg": {"a": [1, None, {"b": 2}], "c": (1, 2)}}
    evaluate("[msg, msg.a[2].b, msg.c]", **values)
    assert values == {"msg": {"a": [1, None, {"b": 2}], "c": (1, 2)}}


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (3, 3.0),
        (True, True),
        (2**53, float(2**53)),
        (2**53 + 1, 2**53 + 1),
        (2**70, float(2**70)),
        ((1, 2), [1.0, 2.0]),
        (np.float64(1.5), 1.5),
        (np.int8(3), 3.0),
        (np.bool_(True), True),
        (np.array([[1, 2]]), [[1.0, 2.0]]),
        ({"a": {"b": 1, "raw": b"x"}}, {"a": {"b": 1.0}}),
        ([b"x", None], [None, None]),
        ("a\0b", "a␀b"),
        ({"a\0": 1}, {"a␀": 1.0}),
        (b"x", None),
    ],
)
def test_normalise_yields_values_that_cel_accepts(value: object, expected: object) -> None:
    result = normalise(value)
    assert result == expected
    assert type(result) is type(expected)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda below: st.lists(below, max_size=4) | st.dictionaries(st.text(), below, max_size=4),
    max_leaves=15,
)


@given(_JSON)
def test_a_value_passes_through_an_expression_unchanged(value: object) -> None:
    assert evaluate("[msg]", msg=value) == [normalise(value)]


def test_endlessly_nested_values_are_an_error_not_a_crash() -> None:
    nested: list[object] = []
    for _ in range(100_000):
        nested = [nested]
    with pytest.raises(EvaluationError, match="nested too deeply"):
        evaluate("size(l)", l=nested)
    while nested:  # taken apart by hand: freeing it at once would recurse as deeply
        nested = nested.pop()  # type: ignore[assignment]


@pytest.mark.parametrize("name", ["in", "a-b", "1x", "", "null"])
def test_a_variable_must_have_a_valid_name(name: str) -> None:
    with pytest.raises(ValueError, match="variable"):
        Environment({name: CelType.DYN})


@pytest.mark.parametrize(
    ("source", "result", "message"),
    [
        ("distance", CelType.BOOL, "must be a boolean; got a number"),
        ("  'a'", CelType.BOOL, "must be a boolean; got a string"),
        ("[1]", CelType.MAP, r"must be a map; got list\(double\)"),
        ("null", CelType.DOUBLE, "must be a number; got null"),
        ("b", CelType.STRING, "must be a string; got a boolean"),
    ],
)
def test_a_result_of_the_wrong_type_is_refused_when_compiled(source: str, result: CelType, message: str) -> None:
    with pytest.raises(ExpressionError, match=message.replace("list\\(double\\)", "list<double>")) as caught:
        ENVIRONMENT.compile(source, result=result)
    assert caught.value.column == len(source) - len(source.lstrip()) + 1
