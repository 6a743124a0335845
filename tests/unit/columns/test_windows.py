"""Aggregates over many ranges at once are, to the last bit, what the aggregate of each window by itself is."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.columns.windows import Ranges, misfits
from detector.engine.columns.windows import aggregated_ranges as in_columns
from detector.engine.counters import RuleCounters
from detector.engine.samples.sample import Arrival
from detector.engine.signals.signals import aggregated
from tests.driving import a_detector, a_rule, compiled
from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN
from wayside.expressions.columns.values import Tag, Texts, column_of, value_at

AGGREGATES = [each for each in Aggregate if each not in (Aggregate.AGE, Aggregate.ACTIVE)]

_PLAIN = [0.0, -0.0, 0.1, 0.2, 0.3, 1.0, -1.0, 2.5, 1e-3, 12345.678]
_HOSTILE = [1e16, -1e16, 1e-16, 1e200, -1e200, 1.7e308, -1.7e308, 5e-324, -5e-324, 2e-310, float("inf"), float("-inf")]
_ODD: list[Any] = [True, False, "D", "", [1.0], [], 2**60 + 1, -(2**62), 2**53 + 1, UNKNOWN, UNKNOWN]

_columns = st.one_of(
    st.lists(st.sampled_from(_PLAIN), max_size=25),
    st.lists(st.sampled_from(_PLAIN + _HOSTILE) | st.floats(allow_nan=False), max_size=25),
    st.lists(st.booleans(), max_size=25),
    st.lists(st.sampled_from(_PLAIN + _ODD), max_size=25),
    st.lists(st.sampled_from(_PLAIN + _HOSTILE + _ODD), max_size=25),
)


@st.composite
def _windows(draw: st.DrawFn) -> tuple[list[Any], list[int], list[bool] | None, list[tuple[int, int]]]:
    """Values with their times, which of them a `where` takes, and ranges of them; one range often follows its like."""
    values = draw(_columns)
    times = sorted(draw(st.lists(st.integers(0, 40), min_size=len(values), max_size=len(values))))
    taken = draw(st.none() | st.lists(st.booleans(), min_size=len(values), max_size=len(values)))
    edge = st.integers(0, len(values))
    ranges = draw(st.lists(st.tuples(edge, edge).map(lambda pair: (min(pair), max(pair))), min_size=1, max_size=10))
    return values, [time * 250_000_000 for time in times], taken, [each for each in ranges for _ in range(2)][1:]


DETECTOR = a_detector()
_SIGNALS = [
    {"name": f"s{at}", "stream": "speed", "aggregate": each.value, "over": "1s"}
    | ({} if each is Aggregate.COUNT else {"value": "msg.v"})
    | ({"quantile": 0.3} if each is Aggregate.QUANTILE else {})
    for at, each in enumerate(AGGREGATES)
]
SIGNALS = {each.aggregate: each for each in compiled(DETECTOR, a_rule(signals=_SIGNALS, when="true"))[0].signals}


@settings(max_examples=150)
@given(_windows())
def test_aggregates_over_ranges_match_those_of_single_windows(
    drawn: tuple[list[Any], list[int], list[bool] | None, list[tuple[int, int]]],
) -> None:
    values, times, taken, windows = drawn
    texts = Texts()
    column = column_of(values, texts)
    samples = [Arrival(time, "speed", str(number), b"") for number, time in enumerate(times)]
    low, high = (np.array(each) for each in zip(*windows, strict=True))
    for aggregate in AGGREGATES:
        rows = Ranges(column.values, column.tags, column.others, np.array(times, np.int64), low, high)
        if taken is not None:
            rows.picked(np.array(taken, bool)[rows.begin : rows.begin + len(rows.values)])
        wrong = misfits(aggregate, rows)
        errors = np.zeros(len(windows)) if wrong is None else wrong[0]
        result = in_columns(aggregate, rows, texts, SIGNALS[aggregate].quantile)
        for at, (begin, end) in enumerate(windows):
            seen = [(samples[row], values[row]) for row in range(begin, end) if taken is None or taken[row]]
            newest_first = seen if aggregate is Aggregate.FIRST else seen[::-1]
            counters = RuleCounters()
            expected = aggregated(SIGNALS[aggregate], "car", newest_first, counters)
            assert repr(value_at(result, at, texts)) == repr(expected), (aggregate, begin, end)
            assert errors[at] == counters.errors, (aggregate, begin, end)


@settings(max_examples=40)
@given(st.data())
def test_sums_of_long_windows_are_rounded_once(data: st.DataObject) -> None:
    seed = data.draw(st.integers(0, 2**32 - 1))
    spread = data.draw(st.sampled_from([0, 3, 10, 40, 150]))
    random = np.random.default_rng(seed)
    values = random.uniform(-1, 1, 400) * 10.0 ** random.integers(-spread, spread + 1, 400)
    low = random.integers(0, 200, 20)
    high = low + random.integers(0, 200, 20)
    samples = [Arrival(number, "speed", "", b"") for number in range(400)]
    for aggregate in (Aggregate.SUM, Aggregate.MEAN):
        result = in_columns(aggregate, Ranges(values, None, None, np.arange(400), low, high), Texts())
        for at in range(20):
            window = [(samples[row], float(values[row])) for row in range(low[at], high[at])][::-1]
            expected = aggregated(SIGNALS[aggregate], "car", window, RuleCounters())
            known = result.tags is None or result.tags[at] == Tag.NUMBER
            assert repr(float(result.values[at]) if known else UNKNOWN) == repr(expected)
