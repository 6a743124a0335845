"""Time: batching and, with clock Data, the order of arrival do not matter; jumps, gaps and steps back."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from detector.engine.timing.data import DataTimeline
from tests.driving import (
    POSITION,
    SECOND,
    START,
    Drive,
    a_detector,
    a_rule,
    a_stream,
    an_engine,
    arrival,
    at,
    lines,
)

WALL = a_detector(a_stream("pose", staleAfter="2s"), a_stream("speed"), clientTimeout="3s", buffer={"duration": "4s"})
DATA = a_detector(
    a_stream("pose", stamp="msg.t", staleAfter="2s"),
    a_stream("speed", stamp="msg.t"),
    clientTimeout="3s",
    buffer={"duration": "4s"},
    clock="Data",
    lateness="400ms",
    maxAhead="1h",
)
RULES = (
    a_rule(
        "fast",
        signals=[
            {"name": "v", "stream": "speed", "value": "msg.v", "aggregate": "Mean", "over": "1s"},
            {"name": "n", "stream": "speed", "aggregate": "Count", "over": "2s"},
            {"name": "age", "stream": "pose", "aggregate": "Age"},
        ],
        when="v > 0.5 || n > 6",
        cooldown="1s",
        unknownTimeout="2s",
        evaluation={"every": "200ms"},
        **{"for": "200ms"},
    ),
    a_rule(
        "near",
        scope={"pairs": {"position": POSITION, "within": 10}},
        signals=[{"name": "last", "stream": "speed", "value": "msg.v"}],
        when="distance < 4 && a.last > 0",
        until="distance > 6",
        evaluation={"every": "300ms"},
    ),
    a_rule(
        "together",
        scope={"fleet": {"members": "v > 0"}},
        signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
        when="size(members) > 1",
        evaluation={"onSample": "speed"},
    ),
)


@st.composite
def drives(draw: st.DrawFn) -> list[tuple[float, str, str, dict[str, float]]]:
    """Time, client, stream, message: ten seconds of a few clients, no two samples of one at the same time."""
    slots = draw(st.sets(st.tuples(st.integers(1, 100), st.sampled_from("abc"), st.sampled_from(["pose", "speed"]))))
    drawn = []
    for time, client, stream in sorted(slots):
        t = (START + time * SECOND // 10) / SECOND
        if stream == "pose":
            message = {"t": t, "x": draw(st.integers(0, 8)), "y": 0}
        else:
            message = {"t": t, "v": draw(st.integers(-2, 2))}
        drawn.append((time / 10, client, stream, message))
    return drawn


def arrivals_of(drive: list[tuple[float, str, str, dict[str, float]]]) -> list[Arrival]:
    """In order of time; many are received at one."""
    return [
        Arrival(at(time), stream, f"vehicles/{client}/{stream}", json.dumps(message).encode())
        for time, client, stream, message in drive
    ]


def in_one_go(detector: Any, arrivals: list[Arrival], until: float) -> list[str]:
    return lines(an_engine(detector, *RULES).advance(arrivals, at(until)))


@settings(max_examples=30, deadline=None)
@given(drives(), st.lists(st.integers(1, 110), max_size=12), st.sampled_from(["wall", "drained", "data"]))
def test_any_split_of_the_arrivals_gives_byte_identical_events(
    drive: list[tuple[float, str, str, dict[str, float]]], cuts: list[int], how: str
) -> None:
    """Drained: the shell reads the clock, then takes what is queued, so samples are later than the time it gives."""
    detector = DATA if how == "data" else WALL
    arrivals = arrivals_of(drive)
    engine = an_engine(detector, *RULES)
    events: list[Event] = []
    rest = arrivals
    for cut in [*sorted(cuts), 120]:
        now = [each for each in rest if each.received <= at(cut / 10)]
        rest = rest[len(now) :]
        events += engine.advance(now, now[0].received if now and how == "drained" else at(cut / 10))
    events += engine.advance([], at(12))
    assert lines(events) == in_one_go(detector, arrivals, 12)


@settings(max_examples=20, deadline=None)
@given(drives(), st.data())
def test_with_clock_data_the_order_of_arrival_does_not_matter_within_the_lateness(
    drive: list[tuple[float, str, str, dict[str, float]]], data: st.DataObject
) -> None:
    arrivals = arrivals_of(drive)
    # Shifted by less than the lateness and then sorted, no sample comes after one that is 400 ms newer.
    shifted = [(each.received + data.draw(st.integers(0, 399)) * 10**6, each) for each in arrivals]
    shuffled = [replace(each, received=START + n) for n, (_, each) in enumerate(sorted(shifted, key=lambda s: s[0]))]
    end = Arrival(at(11), "pose", "vehicles/z/pose", json.dumps({"t": at(10.5) / SECOND}).encode())
    assert in_one_go(DATA, [*shuffled, end], 0) == in_one_go(DATA, [*arrivals, end], 0)


COUNT = a_rule(
    signals=[{"name": "n", "stream": "speed", "aggregate": "Count", "over": "2s"}], when="n >= 2", until="n == 0"
)


def sent(t: float, client: str = "car", *, received: float = 0) -> Arrival:
    """A sample stamped at t, with clock Data; all are received at once by default."""
    return arrival(received, client, {"t": at(t) / SECOND})


def data_drive(*rules: Any, **spec: Any) -> Drive:
    stream = a_stream("speed", stamp="msg.t")
    return Drive(a_detector(stream, clock="Data", **{"lateness": "500ms", **spec}), *(rules or (COUNT,)))


def timeline(drive: Drive) -> DataTimeline:
    found = drive.engine.timeline
    assert isinstance(found, DataTimeline)
    return found


def test_with_clock_data_a_tick_runs_once_a_stamp_of_lateness_beyond_it_was_seen() -> None:
    drive = data_drive()
    assert drive.take(sent(10.8), sent(10.9), sent(11.4), until=99) == []
    assert drive.take(sent(11.5), until=0) == ["r car started 11"]


def test_a_tick_sees_no_later_sample() -> None:
    newest = a_rule(signals=[{"name": "t", "stream": "speed", "value": "msg.t"}], when="t > 0")
    age = a_rule("s", signals=[{"name": "age", "stream": "speed", "aggregate": "Age"}], when="age < 0.25")
    drive = data_drive(newest, age)
    drive.take(sent(10.8), sent(11.3), sent(11.6, "other"), until=0)
    assert drive.take(sent(11.7), until=0) == []
    assert [(event.episode.subject, event.values) for event in drive.events] == [
        ("car", {"t": at(10.8) / SECOND}),
        ("car", {"age": 0.2}),
    ]


def test_a_sample_beyond_the_lateness_is_inserted_in_order_if_the_buffer_covers_it() -> None:
    four = a_rule(signals=COUNT.to_json()["spec"]["signals"], when="n >= 4")
    drive = data_drive(four)
    drive.take(sent(10.1), sent(10.9), sent(11.6), until=0)
    assert drive.engine.now == at(11)
    assert drive.take(sent(10.5), sent(12.5), until=0) == ["r car started 12"]
    late = data_drive()
    late.take(sent(10.9), sent(11.6), sent(10.2), sent(12.5), until=0)
    lane = late.engine.buffer.lane("car", "speed")
    assert lane is not None
    assert [sample.time for sample in lane.samples] == [at(10.2), at(10.9), at(11.6)]
    late = data_drive(buffer={"duration": "2s"}, maxAhead="10s")
    assert late.take(sent(10.5), sent(13.5), sent(12.5), sent(12.4), sent(11.4), until=0) == []
    assert timeline(late).dropped_late == 1  # the one at 11.4: the others are inside the buffer
    assert late.take(sent(14.5), until=0) == ["r car started 14"]


def test_a_stamp_in_the_future_is_dropped_and_counted_and_time_continues() -> None:
    drive = data_drive()
    ahead = sent(3_600, "liar")
    assert drive.take(sent(10.2), ahead, sent(10.6), sent(11.1), ahead, sent(11.6), until=0) == ["r car started 11"]
    assert timeline(drive).dropped_ahead == 2
    assert "liar" not in drive.engine.clients


def test_a_jump_of_time_is_accepted_once_two_clients_agree() -> None:
    drive = data_drive()
    drive.take(*(sent(10 + n / 5, client) for n in range(10) for client in ("a", "b")), until=0)
    assert drive.take(sent(500.1, "a"), sent(500.2, "b"), until=0) == []
    assert timeline(drive).jumps == 1
    assert timeline(drive).dropped_ahead == 1
    drive.take(sent(500.3, "c"), sent(900.1, "a"), sent(900.2, "b"), until=0)
    assert "c" in drive.engine.clients  # it waited for its tick, which the second jump took away
    reported = drive.take(*(sent(900.3 + n / 5, client) for n in range(6) for client in ("a", "b")), until=0)
    assert reported == []  # open since before the jump, and the windows have filled again
    assert [event.episode.subject for event in drive.events] == ["a", "b"]


def test_a_single_client_jumps_with_its_second_sample() -> None:
    drive = data_drive()
    drive.take(sent(10.1), sent(10.2), until=0)
    assert drive.take(sent(3.7), sent(3.8), sent(3.9), sent(4.5), until=0) == []  # inside the buffer: just late
    drive = data_drive(buffer={"duration": "2s"})
    drive.take(sent(10.1), sent(10.2), until=0)
    assert drive.take(sent(3.7), sent(3.8), sent(3.9), sent(4.5), until=0) == ["r car started 4"]
    assert timeline(drive).dropped_late == 1


def test_a_client_must_confirm_a_jump_for_the_timeout_while_another_is_silent() -> None:
    drive = data_drive(clientTimeout="3s")
    drive.take(sent(10, "a"), sent(10, "b"), until=0)
    drive.take(*(sent(500 + n / 2, "a") for n in range(6)), until=0)
    assert timeline(drive).jumps == 0
    drive.take(sent(10.1, "b"), until=0)  # a contradiction: it restarts
    drive.take(*(sent(503 + n / 2, "a") for n in range(6)), until=0)
    assert timeline(drive).jumps == 0
    drive.take(sent(506, "a"), until=0)
    assert timeline(drive).jumps == 1


def test_data_time_begins_with_the_first_stamp_independently_of_the_wall_clock() -> None:
    """A restored client is lost no sooner than clientTimeout after that, and its age is no wall's age."""
    drive = data_drive(clientTimeout="3s")
    drive.engine.clients.note_presence("known", at(10**6))
    drive.take(*(sent(10.2 + n / 2) for n in range(8)), until=0)
    assert "known" in drive.engine.clients
    drive.take(sent(14.6), until=0)
    assert "known" not in drive.engine.clients


def test_a_stream_slower_than_max_ahead_is_not_ahead() -> None:
    drive = data_drive()
    assert drive.take(*(sent(10.2 + 3 * n, received=3 * n) for n in range(4)), until=0) == []
    assert drive.take(sent(21.6, received=11.6), sent(22, received=11.8), sent(22.9, received=12.7), until=0) == [
        "r car started 22"
    ]
    assert timeline(drive).dropped_ahead == 0
    assert drive.take(sent(90, received=13.7), sent(93, received=16.7), sent(100, received=15), until=0) == []
    assert timeline(drive).dropped_ahead == 2  # the ones at 90 and 100: the one at 93 agrees with the first
    assert timeline(drive).jumps == 1


def test_samples_awaiting_their_tick_are_bounded() -> None:
    drive = data_drive(lateness="900ms", buffer={"bytes": "1k"})
    drive.take(*(sent(10 + n / 100) for n in range(20)), until=0)
    assert 0 < timeline(drive).dropped_full < 20
    assert drive.take(sent(10.9), sent(11.8), sent(11.9), until=0) == ["r car started 11"]


def test_a_changed_lateness_keeps_samples_awaiting_their_tick() -> None:
    detector = a_detector(a_stream("speed", stamp="msg.t"), clock="Data", lateness="500ms")
    drive = Drive(detector, COUNT)
    drive.take(sent(10.8), sent(10.9), until=0)
    from detector.assembly import stream_readers

    patient = a_detector(a_stream("speed", stamp="msg.t"), clock="Data", lateness="900ms")
    readers = stream_readers(patient)
    drive.engine.set_detector(patient, readers.decoders, readers.read_key)
    assert len([sample for lane in drive.engine.buffer for sample in lane.samples]) == 2


def test_after_a_gap_windows_are_empty_and_open_episodes_continue() -> None:
    pending = a_rule("p", signals=COUNT.to_json()["spec"]["signals"], when="n >= 1", **{"for": "3s"})
    drive = Drive(a_detector(), COUNT, pending)
    assert drive.take(arrival(0.5, "car", {}), arrival(0.6, "car", {}), until=2) == ["r car started 1"]
    drive.take(arrival(2.5, "car", {}), until=2.9)
    assert drive.note(drive.engine.gap(at(60.5))) == []
    assert drive.engine.now == at(60.5)
    reported = drive.take(arrival(60.9, "car", {}), arrival(62, "car", {}), until=63.5)
    assert reported == []  # r holds; p's onset was forgotten
    assert drive.take(arrival(63.9, "car", {}), until=65) == ["p car started 64"]
    assert drive.engine.demands() == {}
    assert drive.take(until=66) == ["p car Until 66", "r car Until 66"]


def test_a_client_is_not_lost_while_the_detector_is_suspended() -> None:
    drive = Drive(a_detector(clientTimeout="5s"), COUNT)
    drive.take(arrival(0.5, "car", {}), arrival(0.6, "car", {}), until=1)
    drive.engine.gap(at(100))
    assert drive.take(until=101) == ["r car Until 101"]
    assert "car" in drive.engine.clients
    drive.take(until=106)
    assert "car" not in drive.engine.clients


def test_after_a_clock_step_back_the_past_is_forgotten_and_time_continues() -> None:
    age = a_rule("age", signals=[{"name": "age", "stream": "speed", "aggregate": "Age"}], when="age < 0")
    again = a_rule("again", signals=COUNT.to_json()["spec"]["signals"], when="n == 1", until="n == 3", cooldown="10s")
    drive = Drive(a_detector(), COUNT, age, again)
    drive.take(arrival(100.5, "car", {}), until=101)
    assert drive.take(arrival(101.2, "car", {}), arrival(101.5, "car", {}), until=102)[0].startswith("again car Until")
    drive.engine.gap(at(10.5))
    assert drive.engine.next_tick() == at(11)
    assert drive.take(arrival(10.9, "car", {}), until=13) == ["r car Until 13"]
    # A rest does not last longer than the cooldown, though it was to last until 112.
    assert drive.take(arrival(20.9, "car", {}), until=21) == ["again car started 21"]


def test_windows_do_not_reach_across_a_gap_after_a_detector_change() -> None:
    from detector.assembly import stream_readers

    drive = Drive(a_detector(), a_rule(signals=COUNT.to_json()["spec"]["signals"], when="n >= 2"))
    drive.take(arrival(1.5, "car", {}), until=1.9)
    drive.engine.gap(at(2.1))
    changed = a_detector(a_stream("pose"), a_stream("speed"), clientTimeout="20s")
    readers = stream_readers(changed)
    drive.engine.set_detector(changed, readers.decoders, readers.read_key)
    assert drive.take(arrival(2.3, "car", {}), until=2.9) == []
    assert drive.take(until=3) == []


@pytest.mark.parametrize("every", ["10ms", "300ms", "7s", "1m"])
def test_rules_are_evaluated_at_whole_multiples_of_their_period(every: str) -> None:
    rule = a_rule(when="true", until="true", evaluation={"every": every})
    engine: Engine = an_engine(a_detector(), rule, start=0.1)
    engine.advance([arrival(0.205, "car", {})], at(0.25))
    period = rule.spec.evaluation.every.ns
    end = at(0.25) // period * period + 5 * period
    for time in range(at(1), end, SECOND):
        engine.advance([arrival((time - START) / SECOND, "car", {})], time)
    engine.advance([], end)
    assert engine.counters.rules["r"].evaluations == end // period - at(0.205) // period
