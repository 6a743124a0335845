"""Every aggregate of the engine against a computation from the list of all samples."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from tests.driving import SECOND, Drive, a_detector, a_rule, a_stream, arrival, at

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
"""Starts and ends with each change of the probe, so that every tick reports the signals' values."""


@dataclass(frozen=True)
class Sent:
    """A sample of the stream under test."""

    time: float
    payload: Any

    @property
    def value(self) -> Any:
        """The result of VALUE; None if unknown."""
        if not isinstance(self.payload, dict):
            return None
        if "z" in self.payload:
            return math.copysign(math.inf, self.payload["z"]) if self.payload["z"] else None
        return self.payload.get("v")

    @property
    def truth(self) -> bool | None:
        """The result of TRUTH; None if unknown or a text."""
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
def test_aggregates_match_a_computation_over_all_samples(sent: list[Sent], gap: int | None) -> None:
    drive = Drive(DETECTOR, RULE, start=0.5)
    ticks = range(1, TENTHS // 10 + 1)
    arrivals = [arrival(sample.time, "car", sample.payload) for sample in sent]
    arrivals += [Arrival(at(t) - 1, "probe", "vehicles/car/probe", probe(t)) for t in ticks]
    arrivals.sort()
    if gap is None:
        drive.take(*arrivals, until=ticks[-1])
    else:  # the engine was stopped at gap - 1 and continues, 0.9 s later, after what queued up
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
    return (event.time - at(0)) / SECOND
