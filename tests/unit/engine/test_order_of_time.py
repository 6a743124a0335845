"""One order of time: a tick sees all samples up to its time, each is evaluated once, and the end flushes all."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from detector.replay import batches, replaying
from detector.replay.intake_file import Control
from detector.replay.playing import recorded_arrivals
from detector.replay.replaying import ReplayResult, replay_arrivals, replay_intake
from detector.replay.routing import MessageRouter
from tests.driving import (
    POSITION,
    SECOND,
    START,
    Drive,
    a_detector,
    a_rule,
    a_stream,
    arrival,
    at,
    lines,
    reported,
)
from tests.patience import PATIENCE
from tests.unit.engine.live import Live, Recording
from wayside.api import Detector

STEP = SECOND // 10
CLOCKS: tuple[Mapping[str, Any], ...] = (
    {},
    {"clock": "Data", "lateness": "0s"},
    {"clock": "Data", "lateness": "200ms"},
)


def detector_of(clock: Mapping[str, Any], *names: str) -> Detector:
    """With clock Data, the stamp is `msg.t`, in seconds."""
    stamp = {"stamp": "msg.t"} if clock else {}
    return a_detector(*(a_stream(name, **stamp) for name in names or ("pose", "speed")), **clock)


def line(step: int, client: str, stream: str, **message: float) -> str:
    """Of a JSON lines recording: `step` tenths of a second after the start."""
    time = START + step * STEP
    value = {"t": time / SECOND, **message}
    return json.dumps({"t": time, "key": f"vehicles/{client}/{stream}", "value": value})


def replayed(folder: Path, detector: Detector, rules: Sequence[Any], *recordings: Sequence[str]) -> ReplayResult:
    """The replay of recordings, given as their lines."""
    paths = []
    for number, recording in enumerate(recordings):
        path = folder / f"{number}.jsonl"
        path.write_text("\n".join(recording))
        paths.append(path)
    return replay_arrivals(recorded_arrivals(paths, MessageRouter(detector.spec.streams), detector), detector, rules)


APART = {"scope": {"pairs": {"position": POSITION, "within": 1000}}, "when": "distance > 0.0"}
"""Two clients that always move together are never apart."""


@pytest.mark.parametrize("clock", CLOCKS)
@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_two_clients_on_a_common_time_grid_that_always_move_together_never_part(
    clock: Mapping[str, Any], data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    streams = data.draw(st.permutations(["pose", "speed"]))
    recordings: tuple[list[str], list[str]] = ([], [])
    where = data.draw(st.sampled_from([{"a": 0, "b": 0}, {"a": 0, "b": 1}, {"a": 1, "b": 0}]))
    for step in range(1, 25):
        of_the_step = [("a", "pose"), ("b", "pose"), ("a", "speed"), ("b", "speed")]
        for client, stream in data.draw(st.permutations(of_the_step)):
            recordings[where[client]].append(line(step, client, stream, x=step, y=0))
    rules = [
        a_rule("together", evaluation={"onSample": "pose"}, scope=APART["scope"], when="distance == 0.0"),
        a_rule("every", evaluation={"every": "100ms"}, **APART),
        a_rule("second", evaluation={"every": "1s"}, **APART),
        a_rule("at-pose", evaluation={"onSample": "pose"}, **APART),
        a_rule("at-speed", evaluation={"onSample": "speed"}, **APART),
    ]
    outcome = replayed(tmp_path_factory.mktemp("grid"), detector_of(clock, *streams), rules, *recordings)
    assert outcome.samples == 96
    assert reported(outcome.events) == ["together a+b started 0.1"]


@pytest.mark.parametrize("clock", CLOCKS)
def test_a_tick_sees_all_samples_of_its_time_and_each_subject_is_evaluated_once(
    clock: Mapping[str, Any], tmp_path: Path
) -> None:
    count = {"name": "n", "stream": "speed", "aggregate": "Count", "over": "100ms"}
    last = {"name": "v", "stream": "speed", "value": "msg.v"}
    rules = [
        a_rule("tick", signals=[count, last], when="n >= 1", evaluation={"every": "500ms"}),
        a_rule("sample", signals=[count, last], when="n >= 1", evaluation={"onSample": "speed"}),
        a_rule("steps", signals=[last], when="v < 3", evaluation={"onSample": "speed"}),
    ]
    recording = [line(10, "car", "speed", v=1), line(10, "car", "speed", v=2), line(10, "car", "speed", v=3)]
    outcome = replayed(tmp_path, detector_of(clock), rules, recording)
    assert reported(outcome.events) == ["sample car started 1", "tick car started 1"]
    assert [event.values for event in outcome.events] == [{"n": 3.0, "v": 3.0}] * 2


def test_equal_times_are_ordered_by_recording_and_position(tmp_path: Path) -> None:
    signals = [
        {"name": "all", "stream": "speed", "value": "msg.v", "aggregate": "Distinct", "over": "1s"},
        {"name": "v", "stream": "speed", "value": "msg.v"},
        {"name": "before", "stream": "speed", "value": "msg.v", "aggregate": "Previous"},
    ]
    rule = a_rule("r", signals=signals, when="true", evaluation={"every": "1s"})
    first = [line(9, "car", "speed", v=1), line(10, "car", "speed", v=2), line(10, "car", "speed", v=3)]
    second = [line(10, "car", "speed", v=4), line(10, "car", "speed", v=5), line(11, "car", "speed", v=6)]
    (event,) = replayed(tmp_path, detector_of({}), [rule], first, second).events
    assert event.values == {"all": [1.0, 2.0, 3.0, 4.0, 5.0], "v": 5.0, "before": 4.0}


@pytest.mark.parametrize("by_intake", [False, True])
def test_all_samples_of_a_time_are_taken_in_together(monkeypatch: pytest.MonkeyPatch, by_intake: bool) -> None:
    monkeypatch.setattr(replaying, "_BATCH", 4)
    monkeypatch.setattr(batches, "_ARRIVALS", 4)
    monkeypatch.setattr(batches, "_STEP", 4)
    count = {"name": "n", "stream": "speed", "aggregate": "Count", "over": "1s"}
    rule = a_rule(signals=[count], when="n >= 1", evaluation={"onSample": "speed"})
    arrivals = [arrival(0.9 + n // 10, "car", {"n": n}) for n in range(20)]
    if by_intake:
        start = {"kind": "start", "holder": "h", "detector": a_detector().to_json(), "rules": [rule.to_json()]}
        end = Control(at(1.9), {"kind": "end"})
        outcome = replay_intake([Control(START, start), *arrivals, end], None, None)
    else:
        outcome = replay_arrivals([arrivals], a_detector(), [rule])
    assert [event.values for event in outcome.events] == [{"n": 10.0}]


def test_samples_of_a_stall_are_not_evaluated_and_time_stays_monotonic() -> None:
    on_sample = a_rule(
        "sample",
        signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
        when="v > 10",
        evaluation={"onSample": "speed"},
    )
    tick = a_rule("tick", when="true", until="true", evaluation={"every": "1s"})
    drive = Drive(a_detector(), on_sample, tick)
    drive.take(arrival(0.5, "car", {"v": 1}), until=0.9)
    drive.note(drive.engine.gap(at(7.5)))
    assert drive.take(arrival(3, "car", {"v": 20}), arrival(4, "car", {"v": 5}), until=7.5) == []
    assert drive.engine.now == at(7.5)
    assert drive.take(arrival(7.6, "car", {"v": 20}), until=7.9) == ["sample car started 7.6"]


# The end


V = {"name": "v", "stream": "speed", "value": "msg.v"}
LATE = {"clock": "Data", "lateness": "1s"}
BRIEF = (
    a_rule("tick", signals=[V], when="v > 10", evaluation={"every": "100ms"}),
    a_rule("sample", signals=[V], when="v > 10", evaluation={"onSample": "speed"}),
)
"""Of what is sent below, the episode begins and ends within the last `lateness`."""
SENT = [(1, 5), (11, 5), (14, 20), (14, 20), (17, 5), (18, 5)]
"""Tenths of a second, and speeds."""
EXPECTED = ["sample car started 1.4", "tick car started 1.4", "sample car Until 1.7", "tick car Until 1.7"]


def received(detector: Detector, rules: Sequence[Any], sent: Sequence[tuple[int, int]]) -> Recording:
    """The input and output of a live engine that receives this, after its stop."""
    live = Live(detector, rules)
    for step, value in sent:
        live.now = START + step * STEP
        payload = json.dumps({"t": (START + step * STEP) / SECOND, "v": value}).encode()
        live.evaluator.call(lambda payload=payload: live.put([("vehicles/car/speed", payload)])).result(PATIENCE)
        live.evaluator.call(lambda: None).result(PATIENCE)
    return live.stop()


def test_with_clock_data_the_last_lateness_is_evaluated_at_the_end_live_as_in_a_replay(tmp_path: Path) -> None:
    detector = detector_of(LATE)
    recording = received(detector, BRIEF, SENT)
    assert reported(recording.logged) == EXPECTED
    assert lines(replay_intake(recording.records, None, None).events) == lines(recording.logged)
    recorded = [line(step, "car", "speed", v=value) for step, value in SENT]
    outcome = replayed(tmp_path, detector, BRIEF, recorded)
    assert lines(outcome.events) == lines(recording.logged)
    assert outcome.end == START + 18 * STEP


def test_the_task_of_an_episode_within_the_last_lateness_is_there(tmp_path: Path) -> None:
    rule = a_rule(
        signals=[V],
        when="v > 10",
        evaluation={"every": "100ms"},
        actions=[{"name": "start", "deploy": {"templateName": "app"}}],
    )
    recorded = [line(step, "car", "speed", v=value) for step, value in SENT]
    (task,) = replayed(tmp_path, detector_of(LATE), [rule], recorded).tasks.values()
    assert task.spec.end_time == "2026-01-01T00:00:01.700000000Z"


def test_at_the_end_all_waiting_samples_are_in_the_buffer() -> None:
    drive = Drive(detector_of(LATE))
    drive.note(drive.engine.advance([arrival(n / 10, "car", {"t": at(n / 10) / SECOND}) for n in range(1, 16)], 0))
    assert drive.finish() == []
    lane = drive.engine.buffer.lane("car", "speed")
    assert lane is not None
    assert [sample.time for sample in lane.samples] == [at(n / 10) for n in range(1, 16)]
    assert drive.engine.now == at(1.5)


# Intake files of detectors that kept another order


def replayed_before(detector: Detector, rules: Sequence[Any], *records: Arrival | Control) -> list[Event]:
    """The replay of an intake file without an order of time, and without its end."""
    start = {
        "kind": "start",
        "holder": "h",
        "detector": detector.to_json(),
        "rules": [rule.to_json() for rule in rules],
    }
    end = Control(at(9), {"kind": "end"})
    return replay_intake([Control(START, start), *records, end], None, None).events


def recorded_before(detector: Detector, rules: Sequence[Any], *records: Arrival | Control) -> list[str]:
    return reported(replayed_before(detector, rules, *records))


def stamped(step: int, value: float) -> Arrival:
    time = START + step * STEP
    return Arrival(time, "speed", "vehicles/car/speed", json.dumps({"t": time / SECOND, "v": value}).encode())


def test_an_intake_file_without_order_replays_as_recorded() -> None:
    arrivals = [stamped(step, value) for step, value in SENT]
    for number, each in enumerate(arrivals):
        arrivals[number] = replace(each, received=each.received + number)
    assert recorded_before(detector_of(LATE), BRIEF, *arrivals) == []
    # With a lateness of zero, a tick ran with the first stamp of its time.
    tick = a_rule("tick", signals=[V], when="v > 10", evaluation={"every": "1s"})
    detector = detector_of({"clock": "Data", "lateness": "0s"})
    assert recorded_before(detector, [tick], stamped(5, 20), stamped(10, 20)) == ["tick car started 1"]
    # What came during a stall was evaluated.
    sample = a_rule("sample", signals=[V], when="v > 10", evaluation={"onSample": "speed"})
    gap = Control(at(7.5), {"kind": "gap", "until": at(0.9)})
    assert recorded_before(detector_of({}), [sample], stamped(5, 1), gap, stamped(30, 20)) == ["sample car started 3"]


def test_an_intake_file_without_order_has_closing_speeds_that_end_now() -> None:
    """The one in front falls silent; once, that counted as closing in."""
    rule = a_rule(scope=APART["scope"], when="closingSpeed > 3.0", until="false", evaluation={"every": "500ms"})
    arrivals = [
        arrival(n / 2, client, {"x": x + 2.0 * n, "y": 0}, "pose")
        for n in range(1, 8)
        for client, x in (("a", 0), ("b", 9))
        if client == "a" or n <= 4
    ]
    assert recorded_before(a_detector(), [rule], *arrivals) == ["r a+b started 3"]
    assert replay_arrivals([arrivals], a_detector(), [rule]).events == []


def test_an_intake_file_without_order_has_the_former_distances_to_the_last_digit() -> None:
    rule = a_rule(scope=APART["scope"], when="closingSpeed == 0.0", evaluation={"every": "500ms"})
    a, b = (8.1, 0.6183689966753316), (4.3, 0.9170189691149498)
    arrivals = [
        arrival(t, client, {"x": x, "y": y}, "pose") for t in (0.5, 1, 1.5) for client, (x, y) in (("a", a), ("b", b))
    ]
    (event,) = replayed_before(a_detector(), [rule], *arrivals)
    assert (event.values["distance"], str(event.values["closingSpeed"])) == (math.dist(a, b), "-0.0")
    (event,) = replay_arrivals([arrivals], a_detector(), [rule]).events
    dx, dy = a[0] - b[0], a[1] - b[1]
    assert event.values["distance"] == math.sqrt(dx * dx + dy * dy) != math.dist(a, b)
    assert str(event.values["closingSpeed"]) == "0.0"
