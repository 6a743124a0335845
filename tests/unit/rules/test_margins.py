"""The margin of a condition is the robustness of signal temporal logic, unknown where what it compares is."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.results.episodes import EpisodeRow
from detector.results.nearest import nearest_moments
from detector.results.series import Series, SubjectTrace
from tests.driving import POSITION, Drive, a_detector, a_rule, at, place, speed
from wayside.expressions import UNKNOWN, CelType, Environment
from wayside.rules import RuleError, compile_rule
from wayside.rules.margins import margin_of

NAMES = ("a", "b")
SIGNALS = [{"name": name, "stream": "speed", "value": f"msg.{name}"} for name in NAMES]
SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}

_comparisons = st.builds(
    "{} {} {}".format, st.sampled_from(NAMES), st.sampled_from(["<", "<=", ">", ">=", "=="]), st.integers(-3, 3)
)
_formulas = st.recursive(
    _comparisons,
    lambda inner: st.one_of(
        inner.map("!({})".format), st.builds("({}) {} ({})".format, inner, st.sampled_from(["&&", "||"]), inner)
    ),
    max_leaves=6,
)
_numbers = st.floats(-5, 5)


@settings(max_examples=20)
@given(_formulas, st.lists(st.tuples(_numbers, _numbers), min_size=2, max_size=4))
def test_a_margin_matches_rtamt(formula: str, rows: list[tuple[float, float]]) -> None:
    rtamt = pytest.importorskip("rtamt", reason="there is no rtamt for this Python")
    reference = rtamt.StlDiscreteTimeSpecification()
    for name in (*NAMES, "c"):
        reference.declare_var(name, "float")
    theirs = formula.replace("&&", "and").replace("||", "or").replace("!(", "not (")
    reference.spec = f"c = ({theirs})"
    reference.parse()
    columns = dict(zip(NAMES, map(list, zip(*rows, strict=True)), strict=True))
    expected = [margin for _, margin in reference.evaluate({"time": [*range(len(rows))], **columns})]
    source = margin_of(a_rule(signals=SIGNALS, when=formula, margin=dict.fromkeys(NAMES, 1)).spec)
    expression = Environment(dict.fromkeys(NAMES, CelType.DYN)).compile(source)
    found = [expression.evaluate(dict(zip(NAMES, row, strict=True))) for row in rows]
    assert found == pytest.approx(expected)
    held = Environment(dict.fromkeys(NAMES, CelType.DYN)).compile(formula)
    for margin, row in zip(expected, rows, strict=True):
        if margin:
            assert held.evaluate(dict(zip(NAMES, row, strict=True))) is (margin > 0)


def test_unknown_values_make_the_margin_unknown() -> None:
    source = margin_of(a_rule(signals=SIGNALS, when="a > 1 || b > 1", margin={"a": 1, "b": 2}).spec)
    expression = Environment(dict.fromkeys(NAMES, CelType.DYN)).compile(source)
    assert expression.evaluate({"a": 2.0, "b": 7.0}) == 3.0
    assert expression.evaluate_or_unknown({"a": 2.0}) is UNKNOWN
    assert expression.evaluate_or_unknown({"a": 2.0, "b": math.nan}) is UNKNOWN


def test_the_margin_is_a_value_of_events_and_a_signal_for_others() -> None:
    rule = a_rule(
        scope={"pairs": {"position": POSITION, "within": 100}},
        signals=[{"name": "clearest", "of": "margin", "over": "Episode", "aggregate": "Max"}],
        when="distance < 20 && closingSpeed > 1",
        until="margin < -2",
        margin={"distance": 10, "closingSpeed": 2},
    )
    drive = Drive(a_detector(), rule)
    for second, x in enumerate([40.0, 30, 15, 12, 11.5, 11.5, 60], start=1):
        drive.take(place(second, "a", 0), place(second, "b", x), until=second)
    start, end = drive.events
    assert (start.episode.start_time, start.values["margin"]) == (
        at(3),
        0.5,
    )  # 5 m of 10 below 20 m, 14 m/s of 2 above 1 m/s
    assert (end.values["margin"], end.values["clearest"]) == (-24.75, 0.8)


@pytest.mark.parametrize(
    ("spec", "field", "parts"),
    [
        (
            {"when": "a > 1 && b > 1", "margin": {"a": 1}},
            "spec.margin",
            ["`b > 1` needs a scale", "add b, with the difference"],
        ),
        ({"when": "a - b > 1", "margin": {"a": 1, "b": 2}}, "spec.margin", ["different scales", "a signal with of"]),
        ({"when": "a > 1 && b == 'x'", "margin": {}}, "spec.when", ["comparisons of numbers", "`b == 'x'` is not one"]),
        ({"when": "a > 1 && has(labels.x)", "margin": {}}, "spec.when", ["`has(labels.x)` is not one"]),
        (
            {"when": "a > 1", "margin": {"speed": 1}},
            "spec.margin.speed",
            ["the rule has no signal speed; it has a, b"],
        ),
        ({"when": "margin > 1", "margin": {}}, "spec.margin", ["depends on itself"]),
    ],
)
def test_an_invalid_margin_is_rejected_by_field(spec: dict[str, Any], field: str, parts: list[str]) -> None:
    with pytest.raises(RuleError) as caught:
        compile_rule(a_rule(signals=SIGNALS, **spec), a_detector())
    found = {str(each).partition(": ")[0]: str(each) for each in caught.value.problems}
    assert all(part in found[field] for part in parts), found


def test_comparisons_of_one_quantity_need_no_scale() -> None:
    drive = Drive(a_detector(), a_rule(signals=[SPEED], when="v > 3 && v < 8", margin={}))
    drive.take(speed(1, 1), speed(2, 7), until=2)
    assert [event.values["margin"] for event in drive.events] == [1.0]


def test_near_misses_are_listed_by_margin_without_the_approach_to_an_episode() -> None:
    rule = compile_rule(a_rule(signals=[SPEED], when="v > 3", margin={}), a_detector())
    values = [-5.0, -0.5, -2.0, -4.0, -0.25, 1.0, 2.0, -1.0, -3.0, -1.5, math.nan, -2.0]
    series = Series(np.array([at(second) for second in range(len(values))], np.int64), np.array(values))
    trace = SubjectTrace("r", "car", ("car",), {"margin": series})
    episode = EpisodeRow("", "r", "car", ("car",), None, "e", at(5), at(5), at(7), "Until", False)
    found = nearest_moments("", {"r": rule}, [trace], [episode])
    assert [(near.time, near.margin) for near in found] == [(at(1), -0.5), (at(9), -1.5), (at(11), -2.0)]
