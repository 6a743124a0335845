"""The buffer: order, caps, and bytes that add up."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.buffering.buffer import Buffer, Lane
from detector.engine.samples.sample import SAMPLE_OVERHEAD, Sample, StampedSample
from tests.driving import Drive, a_detector, a_rule, a_stream, arrival
from wayside.api import EventRule


def a_lane(client: str = "car", stream: str = "s", duration: int = 10**9, maximum_bytes: int | None = None) -> Lane:
    return Lane(client, stream, duration, maximum_bytes)


def a_sample(time: int, number: int = 0, payload: bytes = b"") -> Sample:
    return StampedSample(time, number, payload, "k")


def held(buffer: Buffer) -> int:
    return sum(len(sample.payload) + SAMPLE_OVERHEAD for lane in buffer for sample in lane.samples)


@given(st.lists(st.integers(0, 20)))
def test_samples_are_ordered_by_time_and_ties_by_arrival(times: list[int]) -> None:
    lane = a_lane()
    for number, time in enumerate(times):
        lane.insert(a_sample(time, number))
    assert [(sample.time, sample.number) for sample in lane.samples] == sorted(
        (time, number) for number, time in enumerate(times)
    )
    if times:
        assert lane.latest == max(times)


@given(st.lists(st.integers(0, 30)), st.integers(0, 40), st.integers(1, 40))
def test_a_window_excludes_its_start_and_includes_its_end(times: list[int], now: int, over: int) -> None:
    lane = a_lane()
    for number, time in enumerate(times):
        lane.insert(a_sample(time, number))
    window = [sample.time for sample in lane.newest_first(now - over, now)]
    assert window == sorted((time for time in times if now - over < time <= now), reverse=True)


@given(st.lists(st.integers(0, 50), min_size=1), st.integers(0, 60), st.integers(1, 60))
def test_samples_older_than_the_duration_are_evicted_but_never_the_newest(
    times: list[int], now: int, duration: int
) -> None:
    lane = a_lane(duration=duration)
    for number, time in enumerate(times):
        lane.insert(a_sample(time, number))
    freed = lane.expire(now)
    young = sorted(time for time in times if time > now - duration)
    assert [sample.time for sample in lane.samples] == (young or [max(times)])
    assert freed == (len(times) - len(lane.samples)) * SAMPLE_OVERHEAD


def test_a_lane_beyond_its_bytes_evicts_the_oldest_samples() -> None:
    lane = a_lane(maximum_bytes=2 * (SAMPLE_OVERHEAD + 10))
    for time in range(4):
        lane.insert(a_sample(time, payload=b"x" * 10))
    assert [sample.time for sample in lane.samples] == [2, 3]
    assert lane.evicted == 2


def test_a_sample_larger_than_the_lanes_limit_is_kept_alone() -> None:
    lane = a_lane(maximum_bytes=5)
    for time in range(3):
        lane.insert(a_sample(time, payload=b"x" * 10))
    assert [sample.time for sample in lane.samples] == [2]


def test_the_total_cap_evicts_the_oldest_sample_of_any_lane() -> None:
    buffer = Buffer(6 * SAMPLE_OVERHEAD)
    lanes = [buffer.add(a_lane(client)) for client in ("a", "b", "c")]
    for time in (5, 1, 4, 2, 6, 3):
        buffer.grew(lanes[time % 3].insert(a_sample(time)))
    assert buffer.evicted == 0
    buffer.grew(lanes[0].insert(a_sample(7)))
    assert sorted(sample.time for lane in buffer for sample in lane.samples) == [3, 4, 5, 6, 7]
    assert buffer.evicted == 2
    buffer.forget("b")  # whose lane had held the oldest
    assert buffer.evicted == 2


def test_at_equal_times_the_total_cap_evicts_by_client_and_stream() -> None:
    buffer = Buffer(6 * SAMPLE_OVERHEAD)
    lanes = [buffer.add(a_lane(*place)) for place in (("c", "s"), ("a", "t"), ("a", "s"), ("b", "s"))]
    for number in range(7):
        buffer.grew(lanes[number % 4].insert(a_sample(5, number)))
    # There is room for five: the two samples of a on s go first.
    assert {(lane.client, lane.stream): len(lane.samples) for lane in lanes} == {
        ("c", "s"): 2,
        ("a", "t"): 2,
        ("a", "s"): 0,
        ("b", "s"): 1,
    }


V = {"stream": "speed", "value": "msg.v"}
OFTEN = a_rule("often", signals=[{"name": "v", **V}], when="v > 99", evaluation={"every": "100ms"})


@pytest.mark.parametrize("others", [(), (OFTEN,)])
def test_samples_older_than_the_duration_are_invisible_at_every_tick_with_any_other_rules(
    others: tuple[EventRule, ...],
) -> None:
    first = {"name": "first", "aggregate": "First", **V}
    rule = a_rule(signals=[first], when="first == 1", evaluation={"onSample": "speed"})
    drive = Drive(a_detector(buffer={"duration": "6s"}), rule, *others)
    sent = [arrival(0.5, "car", {"v": 1}), arrival(3, "car", {"v": 2}), arrival(6.75, "car", {"v": 2})]
    assert drive.take(*sent, until=6.9) == ["r car started 0.5", "r car Until 6.75"]


@pytest.mark.parametrize("others", [(), (OFTEN,)])
def test_a_rule_does_not_change_what_the_total_cap_leaves_to_another(others: tuple[EventRule, ...]) -> None:
    first = {"name": "first", "stream": "pose", "value": "msg.x", "aggregate": "First"}
    brief = a_stream("speed", buffer={"duration": "200ms"})
    rule = a_rule(signals=[first], when="first == 1", until="false", evaluation={"every": "2s"})
    drive = Drive(a_detector(a_stream("pose"), brief, buffer={"bytes": "2k"}), rule, *others)
    kept = [arrival(0.1, "car", {"x": 1}, "pose"), arrival(0.2, "car", {"x": 2}, "pose")]
    many = [arrival(1 + n / 20, "car", {"v": 1}) for n in range(1, 19)]
    assert drive.take(*kept, *many, until=2) == []  # 18 samples of 169 bytes are held: the place at 0.1 gave way


def test_the_newest_sample_stays_when_the_cap_has_room_for_one() -> None:
    buffer = Buffer(2 * SAMPLE_OVERHEAD)
    lane = buffer.add(a_lane())
    for time in range(50):
        buffer.grew(lane.insert(a_sample(time)))
        assert lane.newest is not None
        assert lane.newest.time == time


@dataclass
class BufferStep:
    """An operation on a buffer."""

    what: str
    client: str = ""
    stream: str = ""
    time: int = 0
    payload: bytes = field(default=b"", repr=False)


doings = st.one_of(
    st.builds(
        BufferStep,
        st.just("insert"),
        st.sampled_from("ab"),
        st.sampled_from("st"),
        st.integers(0, 100),
        st.binary(max_size=100),
    ),
    st.builds(BufferStep, st.just("expire"), time=st.integers(0, 120)),
    st.builds(BufferStep, st.just("forget"), st.sampled_from("ab")),
    st.builds(BufferStep, st.just("keep"), stream=st.sampled_from("st")),
    st.builds(BufferStep, st.just("clear")),
)


@settings(max_examples=200)
@given(st.lists(doings, max_size=60), st.integers(400, 5_000), st.one_of(st.none(), st.integers(200, 1_500)))
def test_the_byte_count_matches_the_contents_and_the_cap(
    steps: list[BufferStep], cap: int, lane_cap: int | None
) -> None:
    buffer = Buffer(cap)
    came: set[int] = set()
    for number, step in enumerate(steps):
        match step.what:
            case "insert":
                lane = buffer.add(a_lane(step.client, step.stream, 50, lane_cap))
                buffer.grew(lane.insert(a_sample(step.time, number, step.payload)))
                came.add(number)
            case "expire":
                buffer.expire(step.time)
            case "forget":
                buffer.forget(step.client)
                assert all(lane.client != step.client for lane in buffer)
            case "keep":
                buffer.retain({step.stream})
                assert all(lane.stream == step.stream for lane in buffer)
            case _:
                buffer.step_back(0)
        assert buffer.bytes == held(buffer) <= cap
        assert all(lane.bytes == sum(len(s.payload) + SAMPLE_OVERHEAD for s in lane.samples) for lane in buffer)
        assert {sample.number for lane in buffer for sample in lane.samples} <= came
        assert all(sample.time <= buffer.latest(lane.client) for lane in buffer for sample in lane.samples)
