"""Latched streams: the last sample stays valid until replaced; caps by number; the contents are reported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from detector.engine.buffering.buffer import Buffer, Lane
from detector.engine.buffering.lanes import LatchedLane, by_key
from detector.engine.samples.sample import SAMPLE_OVERHEAD, Sample, StampedSample
from detector.replay.playing import recorded_arrivals
from detector.replay.replaying import replay_arrivals
from detector.replay.routing import MessageRouter
from tests.driving import START, Drive, a_detector, a_rule, a_stream, arrival, at
from wayside.api import Detector

MAP = {"name": "map", "key": "vehicles/${client:*}/map/${tile:*}", "encoding": "json", "latched": True}
ICY = a_rule(
    signals=[
        {"name": "v", "stream": "speed", "value": "msg.v"},
        {"name": "ice", "stream": "map", "value": "msg.ice", "where": 'key.tile == "t1"'},
    ],
    when="ice && v > 10",
)


def a_latched_lane(duration: int = 10) -> LatchedLane:
    return LatchedLane("car", "map", duration, topic=by_key)


def a_sample(time: int, key: str = "k", number: int = 0) -> Sample:
    return StampedSample(time, number, b"x", key)


@given(st.lists(st.tuples(st.integers(0, 50), st.sampled_from("abc"))), st.integers(0, 70))
def test_the_newest_sample_of_each_key_outlives_the_duration(came: list[tuple[int, str]], now: int) -> None:
    lane = a_latched_lane()
    for number, (time, key) in enumerate(came):
        lane.insert(a_sample(time, key, number))
    before = lane.bytes
    freed = lane.expire(now)
    ordered = sorted((time, number, key) for number, (time, key) in enumerate(came))
    last = {key: (time, number) for time, number, key in ordered}
    kept = [(t, n) for t, n, key in ordered if t > now - 10 or last[key] == (t, n)]
    assert [(sample.time, sample.number) for sample in lane.samples] == kept  # type: ignore[union-attr]
    assert lane.bytes == before - freed == len(kept) * (SAMPLE_OVERHEAD + 1)


def test_the_total_cap_evicts_latched_samples_last() -> None:
    buffer = Buffer(4 * (SAMPLE_OVERHEAD + 1))
    latched, plain = buffer.add(a_latched_lane()), buffer.add(Lane("car", "speed", 10))
    buffer.grew(latched.insert(a_sample(1)))
    for time in range(2, 9):
        buffer.grew(plain.insert(a_sample(time)))
    assert [sample.time for sample in latched.samples] == [1]
    for time in range(20, 29):
        buffer.grew(latched.insert(a_sample(time)))
    assert buffer.bytes == latched.bytes <= buffer.maximum_bytes


def test_when_time_steps_back_latched_samples_are_valid_from_then() -> None:
    buffer = Buffer(10_000)
    latched, plain = buffer.add(a_latched_lane()), buffer.add(Lane("car", "speed", 10))
    for lane in (latched, plain):
        for time in (3, 50):
            buffer.grew(lane.insert(a_sample(time, number=time)))
    buffer.step_back(20)
    assert [sample.time for sample in latched.samples] == [3, 20]
    assert latched.latest == 20
    assert not plain.samples
    assert buffer.bytes == latched.bytes
    assert latched.expire(100) == SAMPLE_OVERHEAD + 1  # replaced at 20


def test_identical_samples_of_the_same_time_are_separate_samples() -> None:
    lane = LatchedLane("car", "map", 10, None, 2, topic=by_key)
    logged = arrival(1, "car", {}, "map")
    for _ in range(3):
        lane.insert(replace(logged))
    assert (len(lane.samples), lane.evicted) == (2, 1)
    assert lane.expire(at(60)) == lane.bytes == len(logged.payload) + SAMPLE_OVERHEAD


@given(st.lists(st.integers(0, 30)), st.integers(1, 5))
def test_a_lane_beyond_its_sample_count_evicts_the_oldest(times: list[int], count: int) -> None:
    lane = Lane("car", "s", 100, None, count)
    for number, time in enumerate(times):
        lane.insert(a_sample(time, number=number))
        assert len(lane.samples) <= count
    assert lane.evicted == max(0, len(times) - count)
    assert lane.bytes == len(lane.samples) * (SAMPLE_OVERHEAD + 1)


def test_the_detectors_sample_count_applies_to_received_samples() -> None:
    drive = Drive(a_detector(a_stream("speed", buffer={"count": 2})))
    drive.take(*(arrival(0.1 * n, "a", {"v": n}) for n in range(1, 6)), until=0.6)
    assert [json.loads(sample.payload)["v"] for lane in drive.engine.buffer for sample in lane.samples] == [4, 5]
    (lane,) = drive.engine.buffer
    assert (len(lane.samples), lane.evicted, drive.engine.buffer.evicted) == (2, 3, 3)
    assert lane.bytes == drive.engine.buffer.bytes


def test_latched_samples_never_expire_and_are_kept_for_each_key() -> None:
    drive = Drive(a_detector(a_stream("speed"), MAP, buffer={"duration": "5s"}), ICY)
    tiles = [_tile(0.1, "t1", ice=True), _tile(0.2, "t2", ice=False)]
    assert drive.take(*tiles, arrival(0.5, "a", {"v": 0}), until=20) == []
    assert drive.take(arrival(20.5, "a", {"v": 20}), until=21) == ["r a started 21"]


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_a_replay_delivers_latched_samples_first_wherever_they_were_recorded(tmp_path: Path, clock: str) -> None:
    streams = a_stream("speed", stamp="msg.t"), {**MAP, "stamp": "msg.t"}
    detector = a_detector(*streams, clock=clock, lateness="0s", maxAhead="1s")
    recording = tmp_path / "drive.jsonl"
    lines = [_line(t, "speed", {"v": 20, "t": (START + t * 10**9) / 1e9}) for t in range(1, 6)]
    late = _line(4.5, "map/t1", {"ice": True, "t": (at(-3600)) / 1e9})
    recording.write_text("\n".join([*lines[:4], late, *lines[4:]]))
    events = _replayed(recording, detector)
    assert [(event["type"], event["data"]["startTime"]) for event in events] == [
        ("dev.wayside.event.started", "2026-01-01T00:00:01.000000000Z")
    ]


def _tile(seconds: float, tile: str, *, ice: bool) -> Any:
    return replace(arrival(seconds, "a", {"ice": ice}, "map"), key=f"vehicles/a/map/{tile}")


def _line(seconds: float, place: str, value: object) -> str:
    return json.dumps({"t": at(seconds), "key": f"vehicles/a/{place}", "value": value})


def _replayed(recording: Path, detector: Detector) -> list[dict[str, Any]]:
    arrivals = recorded_arrivals([recording], MessageRouter(detector.spec.streams), detector)
    return [json.loads(event.to_json()) for event in replay_arrivals(arrivals, detector, [ICY]).events]
