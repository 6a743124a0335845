"""Signals: which samples count and when, the values of a sample, and what is unknown."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from detector.engine.samples.sample import Arrival
from tests.driving import SECOND, Drive, a_detector, a_rule, a_stream, an_engine, arrival, at, compiled, reported


def test_samples_at_a_tick_count_and_later_ones_do_not() -> None:
    rule = a_rule(signals=[{"name": "n", "stream": "speed", "aggregate": "Count", "over": "2s"}], when="n == 1")
    drive = Drive(a_detector(), rule)
    assert drive.take(arrival(1, "car", {}), until=1) == ["r car started 1"]
    late = Drive(a_detector(), rule)
    sample = arrival(1, "car", {})
    assert late.note(late.engine.advance([replace(sample, received=sample.received + 1)], at(1.5))) == []
    assert late.take(until=3) == ["r car started 2"]
    assert late.take(until=4) == ["r car Until 4"]  # (2, 4] begins behind what came a nanosecond after 1 s


def test_a_signal_of_a_stale_stream_is_unknown_and_the_stream_is_not_among_the_clients_streams() -> None:
    detector = a_detector(a_stream("pose", staleAfter="2s"), a_stream("speed", staleAfter="Never"))
    stale = a_rule("stale", signals=[{"name": "v", "stream": "pose", "value": "msg.v"}], when="v > 0")
    latched = a_rule("latched", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 0")
    listed = a_rule("listed", when='"pose" in streams')
    drive = Drive(detector, stale, latched, listed)
    one = [arrival(0.5, "car", {"v": 1}, "pose"), arrival(0.5, "car", {"v": 1}, "speed")]
    assert drive.take(*one, until=2) == ["latched car started 1", "listed car started 1", "stale car started 1"]
    assert drive.take(until=25) == ["listed car Until 3"]  # speed was never sent again, and stays valid
    assert drive.engine.counters.rules["stale"].unknowns > 0


def test_values_kept_for_a_rule_are_dropped_with_its_change() -> None:
    def rule(value: str) -> Any:
        return a_rule(
            signals=[{"name": "m", "stream": "speed", "value": value, "aggregate": "Max", "over": "9s"}],
            when="m > 10",
        )

    detector = a_detector()
    drive = Drive(detector, rule("msg.v"))
    assert drive.take(arrival(0.5, "car", {"v": 20, "w": 1}), until=1) == ["r car started 1"]
    assert drive.note(drive.engine.set_rules(compiled(detector, rule("msg.w")))) == ["r car RuleChanged 1"]
    assert drive.take(until=5) == []


def test_a_sample_has_its_key_stamp_latency_and_size() -> None:
    detector = a_detector(
        {"name": "s", "key": "v/${client:*}/${sensor:*}", "encoding": "json", "stamp": "msg.t"}, clientTimeout="1h"
    )
    start = at(0) / 1e9
    rule = a_rule(
        signals=[
            {"name": "left", "stream": "s", "value": "key.sensor", "where": 'key.sensor == "left"'},
            {"name": "right", "stream": "s", "value": "msg.n", "where": 'key.sensor == "right"'},
            {"name": "stamp", "stream": "s", "value": "sample.stamp", "where": 'key.sensor == "left"'},
            {"name": "late", "stream": "s", "value": "sample.latency", "where": 'key.sensor == "left"'},
            {"name": "received", "stream": "s", "value": "sample.received", "where": 'key.sensor == "left"'},
            {"name": "size", "stream": "s", "value": "sample.size", "where": 'key.sensor == "left"'},
        ],
        when="has(labels.x) || left == 'left' && right == 2",
    )
    engine = an_engine(detector, rule)
    payload = json.dumps({"t": start + 0.25, "n": 1}).encode()
    arrivals = [Arrival(at(0.5), "s", "v/car/left", payload), Arrival(at(0.6), "s", "v/car/right", b'{"t": 1, "n": 2}')]
    (event,) = engine.advance(arrivals, at(1))
    assert event.values == {
        "left": "left",
        "right": 2.0,
        "stamp": start + 0.25,
        "late": 0.25,
        "received": start + 0.5,
        "size": float(len(payload)),
    }


def test_a_stamp_that_cannot_be_read_leaves_the_others_alone() -> None:
    detector = a_detector(a_stream("speed", stamp="msg.t"))
    rule = a_rule(signals=[{"name": "s", "stream": "speed", "value": "sample.stamp"}], when="s > 0")
    drive = Drive(detector, rule)
    hostile = [arrival(0.1 * i + 0.1, f"bad{i}", each) for i, each in enumerate(({"t": "x"}, {"t": -1}, {}, b"\xff"))]
    assert drive.take(*hostile, arrival(0.9, "good", {"t": 5}), until=1) == ["r good started 1"]


def test_a_signal_of_bytes_is_null_in_events() -> None:
    rule = a_rule(
        signals=[
            {"name": "raw", "stream": "speed", "value": "[bytes(msg.v), 'x']"},
            {"name": "all", "stream": "speed", "value": "bytes(msg.v)"},
        ],
        when="true",
    )
    drive = Drive(a_detector(), rule)
    drive.take(arrival(0.5, "car", {"v": "secret"}), until=1)
    assert json.loads(drive.events[0].to_json())["data"]["values"] == {"raw": [None, "x"]}


def test_values_of_the_wrong_type_are_skipped_and_counted_as_errors_with_the_expected_type() -> None:
    rule = a_rule(
        signals=[
            {"name": "top", "stream": "speed", "value": "msg.v", "aggregate": "Max", "over": "5s"},
            {"name": "all", "stream": "speed", "value": "msg.v", "aggregate": "All", "over": "5s"},
        ],
        when="top == 3 && all",
    )
    drive = Drive(a_detector(), rule)
    values = [3, "9", True, [1], None]
    arrivals = [arrival(0.1 * i + 0.1, "car", {"v": value}) for i, value in enumerate(values)]
    assert drive.take(*arrivals, until=1) == ["r car started 1"]
    counters = drive.engine.counters.rules["r"]
    assert counters.errors == 3 + 3  # of Max: a text, a boolean, a list; of All: a number, a text, a list
    assert counters.last_error == "signal all of car, stream speed: All needs booleans; got [1.0]"


def test_first_decodes_only_its_sample() -> None:
    rule = a_rule(
        signals=[{"name": "first", "stream": "speed", "value": "msg.v", "aggregate": "First", "over": "9s"}],
        when="first == 1",
    )
    drive = Drive(a_detector(), rule)
    broken = [arrival(0.2 + 0.1 * i, "car", b"{") for i in range(5)]
    assert drive.take(arrival(0.1, "car", {"v": 1}), *broken, until=1) == ["r car started 1"]
    assert drive.engine.counters.undecodable["speed"] == 0


ORDERED = a_rule(
    signals=[
        {"name": name.lower(), "stream": "speed", "value": "msg.v", "aggregate": name, **over}
        for name, over in (
            ("First", {}), ("Last", {}), ("Previous", {}), ("Delta", {"over": "3s"}), ("Rate", {"over": "3s"}),
            ("Distinct", {"over": "3s"}),
        )
    ],
    when="true",
    evaluation={"every": "2s"},
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 20), st.integers(0, 9)), min_size=1, max_size=12))
def test_with_clock_data_samples_are_ordered_by_stamp_and_then_by_arrival(
    sent: list[tuple[int, int]],
) -> None:
    detector = a_detector(
        a_stream("speed", stamp="msg.t"), a_stream("pose", stamp="msg.t"), clock="Data", lateness="3s", maxAhead="1h"
    )  # so that nothing is too late
    zero = at(0) / SECOND
    arrivals = [
        arrival(i / 100, "car", {"t": zero + tenths / 10, "v": value}) for i, (tenths, value) in enumerate(sent)
    ]
    drive = Drive(detector, ORDERED)
    drive.engine.advance(arrivals, at(0))
    drive.take(arrival(5, "car", {"t": zero + 10}, "pose"), until=0)
    in_order = sorted(sent, key=lambda each: each[0])  # stable: those of one time as they came
    times, values = [tenths / 10 for tenths, _ in in_order], [float(value) for _, value in in_order]
    assert reported(drive.events[:1]) == ["r car started 2"]
    found = drive.events[0].values
    assert found["first"] == values[0]
    assert found["last"] == values[-1]
    assert found.get("previous") == (values[-2] if len(values) > 1 else None)
    assert found.get("delta") == (values[-1] - values[0] if len(values) > 1 else None)
    between = times[-1] - times[0]
    assert found.get("rate") == (pytest.approx((values[-1] - values[0]) / between) if between else None)
    assert found["distinct"] == list(dict.fromkeys(values))
