"""Signals: every aggregate against a computation from the list of all samples, and what is unknown."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from tests.driving import SECOND, Drive, a_detector, a_rule, a_stream, an_engine, arrival, at, compiled, told

KEPT, STALE, OVER = 4.0, 3.0, 2.0
"""Seconds: the buffer's duration, staleAfter and the windows."""

VALUE = "has(msg.z) ? msg.z / 0.0 : msg.v"
"""So that JSON can bring NaN ({"z": 0}) and infinities ({"z": ±1})."""

BIG = "msg.v > 1"

TRUTH = "has(msg.z) ? msg.z > 0 : type(msg.v) == bool ? msg.v : type(msg.v) == double ? msg.v > -1 : msg.v"
"""A boolean, a text (which All and Any leave out), or unknown."""

DETECTOR = a_detector(
    a_stream("speed", staleAfter="3s", buffer={"duration": "4s"}), a_stream("probe"), clientTimeout="1h"
)

RULE = a_rule(
    signals=[
        {"name": "probe", "stream": "probe", "value": "msg.on"},
        {"name": "last", "stream": "speed", "value": VALUE},
        {"name": "last_over", "stream": "speed", "value": VALUE, "over": "2s"},
        {"name": "last_big", "stream": "speed", "value": VALUE, "where": BIG},
        {"name": "count", "stream": "speed", "aggregate": "Count", "over": "2s"},
        {"name": "count_big", "stream": "speed", "aggregate": "Count", "over": "2s", "where": BIG},
        {"name": "min", "stream": "speed", "aggregate": "Min", "over": "2s", "value": VALUE},
        {"name": "max_big", "stream": "speed", "aggregate": "Max", "over": "2s", "value": VALUE, "where": BIG},
        {"name": "mean", "stream": "speed", "aggregate": "Mean", "over": "2s", "value": VALUE},
        {"name": "sum", "stream": "speed", "aggregate": "Sum", "over": "2s", "value": VALUE},
        {"name": "deviation", "stream": "speed", "aggregate": "StdDev", "over": "2s", "value": VALUE},
        {"name": "delta", "stream": "speed", "aggregate": "Delta", "over": "2s", "value": VALUE},
        {"name": "rate_big", "stream": "speed", "aggregate": "Rate", "over": "2s", "value": VALUE, "where": BIG},
        {"name": "rate", "stream": "speed", "aggregate": "Rate", "over": "2s", "value": VALUE},
        {"name": "first", "stream": "speed", "aggregate": "First", "value": VALUE},
        {"name": "first_over", "stream": "speed", "aggregate": "First", "over": "2s", "value": VALUE},
        {"name": "previous", "stream": "speed", "aggregate": "Previous", "value": VALUE},
        {"name": "previous_big", "stream": "speed", "aggregate": "Previous", "value": VALUE, "where": BIG},
        {"name": "all", "stream": "speed", "aggregate": "All", "over": "2s", "value": TRUTH},
        {"name": "any", "stream": "speed", "aggregate": "Any", "over": "2s", "value": TRUTH},
        {"name": "distinct", "stream": "speed", "aggregate": "Distinct", "over": "2s", "value": VALUE},
        {"name": "age", "stream": "speed", "aggregate": "Age"},
        {"name": "age_big", "stream": "speed", "aggregate": "Age", "where": BIG},
    ],
    when="probe",
    until="!probe",
)
"""Starts and ends with each change of the probe, so that every tick tells the signals' values."""


@dataclass(frozen=True)
class Sent:
    """A sample of the stream under test."""

    time: float
    payload: Any

    @property
    def value(self) -> Any:
        """What VALUE makes of it; None where that is unknown."""
        if not isinstance(self.payload, dict):
            return None
        if "z" in self.payload:
            return math.copysign(math.inf, self.payload["z"]) if self.payload["z"] else None
        return self.payload.get("v")

    @property
    def truth(self) -> bool | None:
        """What TRUTH makes of it; None where that is unknown or a text."""
        if not isinstance(self.payload, dict):
            return None
        if "z" in self.payload:
            return bool(self.payload["z"] > 0)
        value = self.payload.get("v")
        return value if isinstance(value, bool) else value > -1 if isinstance(value, int | float) else None

    @property
    def is_big(self) -> bool:
        """Whether BIG is true for it."""
        value = self.payload.get("v") if isinstance(self.payload, dict) else None
        return isinstance(value, int | float) and not isinstance(value, bool) and value > 1


def expected(sent: list[Sent], now: float, since: float, gap: float | None) -> dict[str, Any]:
    """The signals that are known at `now`, from all that was sent; `since`: when the client's first sample came."""
    past = [sample for sample in sent if sample.time <= now]
    kept = [sample for sample in past if sample.time > now - KEPT or sample is past[-1]]
    window = [s for s in past if s.time > max(now - OVER, -math.inf if gap is None else gap)]
    big = [sample for sample in past if sample.is_big]
    known: dict[str, Any] = {
        "count": len(window),
        "any": any(s.truth for s in window),
        "count_big": sum(sample.is_big for sample in window),
        "age": now - (past[-1].time if past else since),
        "age_big": now - (big[-1].time if big else since),
    }
    if past and now - past[-1].time <= STALE:
        known["last"] = past[-1].value
        known["last_over"] = window[-1].value if window else None
        known["last_big"] = next((sample.value for sample in reversed(kept) if sample.is_big), None)
        known["min"] = min(numbers(window), default=None)
        known["max_big"] = max(numbers([sample for sample in window if sample.is_big]), default=None)
        known["mean"] = mean(numbers(window))
        known["sum"] = total(numbers(window))
        known["deviation"] = deviation(numbers(window))
        known["delta"] = delta(of_numbers(window))
        known["rate"] = rate(of_numbers(window))
        known["rate_big"] = rate(of_numbers([sample for sample in window if sample.is_big]))
        known["first"] = kept[0].value
        known["first_over"] = window[0].value if window else None
        known["previous"] = kept[-2].value if len(kept) > 1 else None
        known["previous_big"] = ([None, None] + [sample for sample in kept if sample.is_big])[-2]
        known["previous_big"] = known["previous_big"].value if known["previous_big"] else None
        truths = [sample.truth for sample in window if sample.truth is not None]
        known["all"] = all(truths) if truths else None
        known["distinct"] = distinct([sample.value for sample in window]) or None
    return {name: value for name, value in known.items() if value is not None}


def of_numbers(samples: list[Sent]) -> list[Sent]:
    return [s for s in samples if isinstance(s.value, int | float) and not isinstance(s.value, bool)]


def numbers(samples: list[Sent]) -> list[float]:
    return [sample.value for sample in of_numbers(samples)]


def total(values: list[float]) -> float | None:
    infinite = {value for value in values if math.isinf(value)}
    if infinite:
        return infinite.pop() if len(infinite) == 1 else None
    exact = sum(map(Fraction, values))
    try:
        return float(exact) if values else None
    except OverflowError:
        return math.inf if exact > 0 else -math.inf


def deviation(values: list[float]) -> float | None:
    if not values or any(map(math.isinf, values)):
        return None
    middle = sum(map(Fraction, values)) / len(values)
    square = sum((Fraction(value) - middle) ** 2 for value in values) / len(values)
    scale = max(1, math.isqrt(int(square)))
    return scale * math.sqrt(square / scale**2)


def delta(samples: list[Sent]) -> float | None:
    if len(samples) < 2:
        return None
    return total([samples[-1].value, -samples[0].value])


def rate(samples: list[Sent]) -> float | None:
    difference = delta(samples)
    if difference is None:
        return None
    seconds = samples[-1].time - samples[0].time
    if any(math.isinf(sample.value) for sample in (samples[0], samples[-1])):
        return difference
    exact = (Fraction(samples[-1].value) - Fraction(samples[0].value)) / Fraction(seconds)
    try:
        return float(exact)
    except OverflowError:
        return math.inf if exact > 0 else -math.inf


def distinct(values: list[Any]) -> list[Any]:
    found: list[Any] = []
    for value in values:
        plain = float(value) if isinstance(value, int) and not isinstance(value, bool) else value
        if plain is not None and not any(plain == other and type(plain) is type(other) for other in found):
            found.append(plain)
    return found


def mean(values: list[float]) -> float | None:
    infinite = {value for value in values if math.isinf(value)}
    if infinite:
        return infinite.pop() if len(infinite) == 1 else None
    return float(sum(map(Fraction, values)) / len(values)) if values else None


def alike(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, float) and isinstance(found, float):
        return math.isclose(found, wanted, rel_tol=1e-9, abs_tol=1e-6)
    return bool(found == wanted) and isinstance(found, bool) == isinstance(wanted, bool)


payloads = st.one_of(
    st.builds(lambda v: {"v": v}, st.floats(-1e3, 1e3) | st.integers(-3, 3) | st.sampled_from([1.7e308, -1.7e308])),
    st.sampled_from([{"v": None}, {}, {"v": "text"}, {"v": True}, {"z": 0}, {"z": 1}, {"z": -1}, [], "v", b"{"]),
)
TENTHS = 120


@st.composite
def streams(draw: st.DrawFn) -> list[Sent]:
    """At most one sample each tenth of a second, so also exactly at ticks; often none for a while."""
    times = sorted(draw(st.sets(st.integers(1, TENTHS), max_size=40)))
    return [Sent(time / 10, draw(payloads)) for time in times]


@example(sent=[Sent(0.1, {"v": -1.7e308}), Sent(1.1, {"v": 1.7e308})], gap=None)
@settings(max_examples=150)
@given(streams(), st.none() | st.integers(2, 9))
def test_aggregates_are_what_a_look_at_all_samples_says(sent: list[Sent], gap: int | None) -> None:
    drive = Drive(DETECTOR, RULE, start=0.5)
    ticks = range(1, TENTHS // 10 + 1)
    arrivals = [arrival(sample.time, "car", sample.payload) for sample in sent]
    arrivals += [Arrival(at(t) - 1, "probe", "vehicles/car/probe", probe(t)) for t in ticks]
    arrivals.sort()
    if gap is None:
        drive.take(*arrivals, until=ticks[-1])
    else:  # the engine was stopped at gap - 1 and goes on, 0.9 s later, after what queued up
        split = [a for a in arrivals if a.received <= at(gap - 1)]
        drive.take(*split, until=gap - 1)
        drive.note(drive.engine.gap(at(gap - 0.1)))
        drive.take(*arrivals[len(split) :], until=ticks[-1])
    first = min(a.received for a in arrivals)
    since = (first - at(0)) / SECOND
    seen = [(event_time(event), event.values) for event in drive.events]
    assert [time for time, _ in seen] == list(ticks)
    for now, values in seen:
        wanted = expected(sent, now, since, None if gap is None or now < gap else gap - 0.1)
        found = {name: value for name, value in values.items() if name != "probe"}
        assert found.keys() == wanted.keys(), now
        assert all(alike(found[name], wanted[name]) for name in wanted), (now, found, wanted)


def probe(tick: int) -> bytes:
    return json.dumps({"on": tick % 2 == 1}).encode()


def event_time(event: Event) -> float:
    return ((event.start_time if event.end_time is None else event.end_time) - at(0)) / SECOND


def test_what_is_received_exactly_at_a_tick_counts_and_what_comes_a_nanosecond_later_does_not() -> None:
    rule = a_rule(signals=[{"name": "n", "stream": "speed", "aggregate": "Count", "over": "2s"}], when="n == 1")
    drive = Drive(a_detector(), rule)
    assert drive.take(arrival(1, "car", {}), until=1) == ["r car started 1"]
    late = Drive(a_detector(), rule)
    sample = arrival(1, "car", {})
    assert late.note(late.engine.advance([sample._replace(received=sample.received + 1)], at(1.5))) == []
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
    assert drive.take(until=25) == ["listed car Until 3"]  # speed was never told again, and still holds
    assert drive.engine.counters.rules["stale"].unknowns > 0


def test_values_kept_of_a_rule_do_not_outlive_its_change() -> None:
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


def test_a_sample_tells_its_key_stamp_latency_and_size() -> None:
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


def test_a_signal_of_bytes_travels_as_null() -> None:
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


def test_values_of_the_wrong_kind_are_left_out_and_counted_as_errors_with_what_was_wanted() -> None:
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
    assert counters.last_error == "signal all of car, stream speed: All needs booleans, is [1.0]"


def test_first_decodes_only_the_sample_that_it_is() -> None:
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
def test_with_clock_data_samples_count_in_order_of_their_stamps_and_those_of_one_time_as_they_came(
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
    assert told(drive.events[:1]) == ["r car started 2"]
    found = drive.events[0].values
    assert found["first"] == values[0]
    assert found["last"] == values[-1]
    assert found.get("previous") == (values[-2] if len(values) > 1 else None)
    assert found.get("delta") == (values[-1] - values[0] if len(values) > 1 else None)
    between = times[-1] - times[0]
    assert found.get("rate") == (pytest.approx((values[-1] - values[0]) / between) if between else None)
    assert found["distinct"] == list(dict.fromkeys(values))
