"""Bad input is dropped or unknown, counted, and affects no other client."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from detector.engine.buffering import ingest
from detector.engine.samples.sample import Arrival
from tests.driving import POSITION, Drive, a_deploy, a_detector, a_rule, a_stream, arrival, at, lines
from tests.ros_messages import cdr, pose_stamped

RULES = (
    a_rule(
        "near",
        scope={"pairs": {"position": {**POSITION, "z": "msg.z"}, "within": 100}},
        signals=[
            {"name": "text", "stream": "pose", "value": "msg.text"},
            {"name": "most", "stream": "pose", "value": "msg.x", "aggregate": "Max", "over": "5s"},
        ],
        when="distance < 10",
        until="distance > 20",
        actions=[a_deploy("x", parameters={"text": "${a.text}", "list": "${[a.most, b.most]}"})],
    ),
    a_rule(
        "fast",
        signals=[
            {"name": "v", "stream": "speed", "value": "msg.v"},
            {"name": "mean", "stream": "speed", "value": "msg.v", "aggregate": "Mean", "over": "5s"},
            {"name": "n", "stream": "speed", "where": "msg.v > 1 || msg.ok", "aggregate": "Count", "over": "5s"},
        ],
        when="v > 10 || mean > 12 || n > 3",
        actions=[a_deploy("x", parameters={"v": "v is ${v}"})],
    ),
)
GOOD = [
    each
    for n in range(6)
    for each in (
        arrival(n + 0.5, "good1", {"x": 10 * n, "y": 0, "z": 0, "text": "a"}, "pose"),
        arrival(n + 0.6, "good2", {"x": 25, "y": 0, "z": 0, "text": "b"}, "pose"),
        arrival(n + 0.7, "good1", {"v": 20 if 1 < n < 4 else 1}),
    )
]
UNHARMED = [
    *("near good1+good2 started 3", "fast good1 started 3"),
    *("near good1+good2 Until 6", "fast good1 Until 5"),
]

numbers = (
    st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**70), 2**70) | st.sampled_from([1e308, 1e13])
)
anything = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)
messages = st.one_of(
    st.binary(max_size=20),
    anything.map(lambda value: json.dumps(value).encode()),
    st.fixed_dictionaries(
        {}, optional={"x": anything, "y": anything, "z": anything, "v": anything, "text": anything, "ok": anything}
    ).map(lambda value: json.dumps(value).encode()),
)
names = st.sampled_from(
    ["bad1", "bad2", "good1+good2", "", "ü", "a b", "*", "%41", "x" * 64, "~fleet", "a\x00b", "a\nb"]
)


@cache
def of_the_good_ones_alone() -> list[str]:
    alone = Drive(a_detector(), *RULES)
    alone.take(*GOOD, until=8)
    assert len(alone.events) == 4
    return lines(alone.events)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 5999), names, st.sampled_from(["pose", "speed"]), messages), max_size=30))
@example([(n * 10, f"bad{n % 2 + 1}", "pose", b'{"x": 1e308, "y": -1e308, "z": 0}') for n in range(30)])
def test_bad_input_of_a_client_changes_no_event_of_others(
    bad: list[tuple[int, str, str, bytes]],
) -> None:
    hostile = [arrival(time / 1000, name, payload, stream) for time, name, stream, payload in bad]
    drive = Drive(a_detector(), *RULES)
    drive.take(*sorted([*GOOD, *hostile]), until=8)
    assert [e for e in lines(drive.events) if '"good1"' in e and '"bad' not in e] == of_the_good_ones_alone()
    assert all("good" in name or "bad" in name for name in drive.engine.clients)


def test_clients_at_invalid_positions_are_near_no_other() -> None:
    drive = Drive(a_detector(), *RULES)
    impossible = [
        arrival(0.1 + n / 100, f"bad{n}", {"x": 1e308 * (-1) ** n, "y": 1e13, "z": 0}, "pose") for n in range(40)
    ]
    here = [arrival(0.9, f"good{n}", {"x": 5 * n, "y": 0, "z": 0}, "pose") for n in (1, 2)]
    assert drive.take(*impossible, *here, until=1) == ["near good1+good2 started 1"]
    assert drive.engine.counters.rules["near"].unknowns >= 40


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(("x", "y"), [(NAN, 0.0), (0.0, NAN), (INF, 0.0), (-INF, INF)])
def test_coordinates_that_are_not_numbers_are_unknown(x: float, y: float) -> None:
    detector = a_detector(a_stream("pose", encoding="cdr", type="geometry_msgs/msg/PoseStamped"))
    position = {"stream": "pose", "x": "msg.pose.position.x", "y": "msg.pose.position.y"}
    rule = a_rule(scope={"pairs": {"position": position, "within": 1e6}}, when="distance >= 0")
    drive = Drive(detector, rule)
    placed = {"a": pose_stamped(0.0, 0.0), "b": pose_stamped(x, y), "c": pose_stamped(3.0, 4.0)}
    reported = drive.take(*(arrival(0.5, client, cdr(message), "pose") for client, message in placed.items()), until=1)
    assert reported == ["r a+c started 1"]
    assert drive.events[0].values["distance"] == 5
    assert drive.engine.counters.rules["r"].unknowns == 1


def test_infinities_and_nan_do_not_enter_events() -> None:
    signals = [
        {"name": "inf", "stream": "speed", "value": "1.0 / msg.zero"},
        {"name": "nan", "stream": "speed", "value": "0.0 / msg.zero"},
        {"name": "both", "stream": "speed", "value": "[1.0 / msg.zero, 2.0]"},
    ]
    rule = a_rule(signals=signals, when="inf > 5", actions=[a_deploy("x", parameters={"v": "${inf}"}), a_deploy("y")])
    drive = Drive(a_detector(), rule)
    assert drive.take(arrival(0.5, "car", {"zero": 0}), until=1) == ["r car started 1"]
    assert json.loads(drive.events[0].to_json())["data"]["values"] == {"both": [None, 2.0]}
    assert [demand.action for demand in drive.engine.demands().values()] == ["y"]
    assert "JSON cannot represent" in drive.engine.counters.rules["r"].last_error


def test_unreadable_payloads_are_counted_by_stream_with_the_last_reason() -> None:
    drive = Drive(a_detector(), *RULES)
    drive.take(arrival(0.1, "car", b"{"), arrival(0.2, "bus", b"\xff"), arrival(0.3, "car", b"", "pose"), until=1)
    counters = drive.engine.counters
    assert counters.undecodable == {"speed": 2, "pose": 1}
    assert set(counters.last_undecodable) == {"speed", "pose"}
    assert counters.samples == {"speed": 2, "pose": 1}
    assert sorted(drive.engine.clients) == ["bus", "car"]  # they are there, though nobody understands them


def test_a_failing_expression_is_an_error_and_a_missing_input_is_not() -> None:
    rule = a_rule(signals=[{"name": "v", "stream": "speed", "value": "msg.v + 1"}], when="v > 3")
    drive = Drive(a_detector(), rule)
    drive.take(
        arrival(0.1, "texts", {"v": "text"}), arrival(0.2, "misses", {}), arrival(0.3, "good", {"v": 3}), until=1
    )
    counters = drive.engine.counters.rules["r"]
    assert counters.errors == 1
    assert "`+` does not take a string and a number" in counters.last_error
    assert counters.unknowns >= 1
    assert [event.episode.subject for event in drive.events] == ["good"]


def test_keys_without_a_client_are_counted_and_leave_no_state() -> None:
    drive = Drive(a_detector(), *RULES)
    bad = [
        *("vehicles/speed", "vehicles/a/b/speed", "vehicles/a b/speed", "vehicles//speed", "vehicles/ü/speed", ""),
        f"vehicles/{'x' * 64}/speed",
    ]
    drive.note(drive.engine.advance([Arrival(at(0.1) + n, "speed", key, b"{}") for n, key in enumerate(bad)], at(1)))
    assert drive.engine.counters.unnamed == {"speed": len(bad)}
    assert drive.engine.counters.samples.total() == 0
    assert list(drive.engine.clients) == []
    assert list(drive.engine.buffer) == []


def test_a_sample_of_an_unknown_stream_is_counted() -> None:
    for clock in ("Wall", "Data"):
        drive = Drive(a_detector(clock=clock))
        drive.engine.advance([Arrival(at(0.1), "gone", "vehicles/car/gone", b"{}")], at(1))
        assert drive.engine.counters.unnamed == {"gone": 1}


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_clients_beyond_the_limit_are_dropped_and_known_clients_stay(
    monkeypatch: pytest.MonkeyPatch, clock: str
) -> None:
    monkeypatch.setattr(ingest, "MAXIMUM_CLIENTS", 3)
    drive = Drive(a_detector(clock=clock, clientTimeout="5s", lateness="100ms"), *RULES)
    reported = drive.take(
        *(arrival(0.1 + n / 100, f"made{n}" if n else "car", {"v": 1}) for n in range(10)),
        arrival(0.5, "car", {"v": 20}),
        arrival(1.5, "car", {"v": 20}),
        until=1.5,
    )
    assert reported == ["fast car started 1"]
    assert len(drive.engine.clients) == 3
    assert drive.engine.counters.crowded == {"speed": 7}
    drive.take(*(arrival(2 + n / 2, "car", {"v": 20}) for n in range(12)), arrival(8, "new", {"v": 1}), until=8)
    drive.take(arrival(8.9, "car", {"v": 20}), arrival(9.2, "car", {"v": 20}), until=9.2)
    assert sorted(drive.engine.clients) == ["car", "new"]  # the others timed out and gave room


def test_a_bounded_number_of_lost_clients_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "MAXIMUM_LOST", 2)
    drive = Drive(a_detector(clientTimeout="2s"), *RULES)
    for n in range(9):
        drive.take(arrival(5 * n + 0.5, f"made{n}", {"v": 1}), until=5 * n + 5)
    assert sorted(lane.client for lane in drive.engine.buffer) == ["made7", "made8"]
    assert drive.engine.buffer.bytes == sum(lane.bytes for lane in drive.engine.buffer)
    # It returns and stays, so it is not lost any more, and not the one to forget.
    stays = [arrival(45.5 + second, "made7", {"v": 1}) for second in range(20)]
    pass_by = [arrival(46.2 + 4 * n, f"later{n}", {"v": 1}) for n in range(4)]
    drive.take(*sorted(stays + pass_by), until=66)
    assert sorted(lane.client for lane in drive.engine.buffer) == ["later2", "later3", "made7"]


def test_the_keys_of_a_client_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "MAXIMUM_KEYS", 10)
    detector = a_detector({"name": "s", "key": "v/${client:*}/${part:*}", "encoding": "json"})
    rule = a_rule(signals=[{"name": "n", "stream": "s", "aggregate": "Count", "over": "9s"}], when="n == 100")
    drive = Drive(detector, rule)
    arrivals = [Arrival(at(0.1) + n, "s", f"v/car/{n}", b"{}") for n in range(100)]
    assert drive.note(drive.engine.advance(arrivals, at(1))) == ["r car started 1"]
    known: Any = drive.engine._inputs.ingest._lanes["s"]
    assert len(known) <= 10


def test_the_states_of_removed_subjects_are_forgotten() -> None:
    detector = a_detector(clientTimeout="2s")
    rule = a_rule(signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10", cooldown="4s")
    drive = Drive(detector, rule)
    for n in range(30):
        drive.take(arrival(n + 0.5, f"car{n}", {"v": 20}), until=n + 1)
    run: Any = drive.engine.rules["r"]
    assert len(run.states) < 10
    signals: Any = drive.engine._inputs.signals
    assert len(signals._extracted) < 5
    assert len(drive.events) > 50


FAST = a_rule(signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10")


@pytest.mark.parametrize(
    "rest",
    [b'"\xff"', b'"\\ud800"', b"1e999", b"01", b"[1,]", b"NaN", b"tru", b"[" * 70 + b"]" * 70, b'1}, {"v": 1'],
)
def test_json_broken_outside_the_read_fields_is_still_a_decode_error(rest: bytes) -> None:
    drive = Drive(a_detector(), FAST)
    whole, broken = b'{"v": 20, "w": 1}', b'{"v": 20, "w": ' + rest + b"}"
    reported = drive.take(arrival(0.5, "car", whole), arrival(0.5, "bus", broken), until=1)
    assert reported == ["r car started 1"]
    assert drive.engine.counters.undecodable == {"speed": 1}


def test_a_message_that_no_rule_reads_is_not_decoded() -> None:
    drive = Drive(a_detector(), FAST)
    broken = [arrival(0.4, "car", b"{"), arrival(0.6, "car", b"{", "pose")]
    assert drive.take(*broken, arrival(0.9, "car", {"v": 20}), until=1) == ["r car started 1"]
    assert drive.engine.counters.undecodable == {}
