"""The buffer as plugins see it: each query compared with the list of all samples."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.queries.geometry import Pose, PoseError, pose_in, slerp, unit
from detector.engine.queries.queries import BufferQueries, matched, nearest_index
from tests.driving import Drive, a_detector, a_stream, arrival, at

STAMPED = {"stamp": "msg.t"}
DETECTOR = a_detector(a_stream("pose", **STAMPED), a_stream("scan", **STAMPED), clientTimeout="1h")

sent = st.lists(
    st.tuples(st.integers(1, 60), st.sampled_from("ab"), st.sampled_from(["front", "rear"])),
    max_size=20,
    unique_by=lambda each: each[0],
)
"""Seconds in tenths, client, frame."""


def queried(*arrivals: Any, until: float) -> BufferQueries:
    drive = Drive(DETECTOR)
    drive.take(*arrivals, until=until)
    return drive.engine.queries()


def a_scan(tenths: int, client: str, frame: str = "front", stamp: float | None = None) -> Any:
    t = at(tenths / 10 if stamp is None else stamp) / 1e9
    return arrival(tenths / 10, client, {"t": t, "header": {"frame_id": frame}, "n": tenths}, "scan")


@settings(deadline=None)
@given(sent, st.sampled_from(["a", None]), st.sampled_from(["front", None]), st.integers(0, 5), st.integers(0, 60))
def test_queries_by_time_client_and_frame_find_the_samples(
    scans: list[tuple[int, str, str]], client: str | None, frame: str | None, count: int, after: int
) -> None:
    scans = sorted(scans)
    queries = queried(*(a_scan(*scan) for scan in scans), until=7)
    fitting = [t for t, c, f in scans if client in (None, c) and frame in (None, f)]
    found = queries.between(client, "scan", at(after / 10), at(5), frame=frame)
    assert [sample.message["n"] for sample in found] == [t for t in fitting if after < t <= 50]
    last = queries.last(client, "scan", count, frame=frame)
    assert [sample.message["n"] for sample in last] == fitting[max(0, len(fitting) - count) :]
    newest = queries.newest(client, "scan", frame=frame)
    assert (newest and newest.message["n"]) == (fitting[-1] if fitting else None)
    near = queries.nearest(client, "scan", at(after / 10), frame=frame)
    assert (near and near.message["n"]) == min(fitting, key=lambda t: (abs(t - after), t), default=None)


def test_a_view_sees_nothing_later_than_its_tick() -> None:
    drive = Drive(DETECTOR)
    drive.take(a_scan(5, "a"), a_scan(15, "a"), until=1.5)
    engine = drive.engine
    queries = BufferQueries(
        at(1), None, engine.buffer, engine.clients, engine._inputs.messages, {"scan": None}, engine._inputs.transforms
    )
    assert [sample.message["n"] for sample in queries.last("a", "scan", 9)] == [5]
    assert queries.nearest("a", "scan", at(1.5)) == queries.newest("a", "scan") != None  # noqa: E711
    assert queries.between("a", "scan", 0, at(9)) == queries.last("a", "scan", 9)
    assert queries.tuples("a", ["scan"], 0) == [tuple(queries.last("a", "scan", 9))]


def test_undecodable_samples_are_skipped_and_counted() -> None:
    drive = Drive(a_detector())
    drive.take(arrival(0.1, "a", {"v": 1}), arrival(0.2, "a", b"no json"), until=0.5)
    assert [sample.message for sample in drive.engine.queries().last("a", "speed", 5)] == [{"v": 1.0}]
    assert drive.engine.counters.undecodable["speed"] == 1


def test_a_range_does_not_reach_back_over_a_gap_and_the_newest_does() -> None:
    drive = Drive(DETECTOR)
    drive.take(a_scan(5, "a"), until=0.6)
    drive.note(drive.engine.gap(at(3)))
    queries = drive.engine.queries()
    assert queries.between("a", "scan", 0, at(9)) == []
    newest = queries.newest("a", "scan")
    assert newest is not None
    assert newest.message["n"] == 5


def a_pose(seconds: float, stamp: float, x: float, yaw: float) -> Any:
    turn = {"x": 0, "y": 0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    value = {"t": at(stamp) / 1e9, "pose": {"position": {"x": x, "y": 0}, "orientation": turn}}
    return arrival(seconds, "a", value, "pose")


@settings(deadline=None)
@given(st.floats(0, 1), st.floats(-3, 3))
def test_between_two_samples_the_position_is_on_the_line_and_the_heading_on_the_arc(share: float, yaw: float) -> None:
    queries = queried(a_pose(2.5, 2, 10, yaw), a_pose(2.6, 1, 0, 0), until=3)  # arrived the other way round
    pose = queries.pose("a", "pose", at(1 + share))
    exact = (at(1 + share) - at(1)) / 1e9  # to the microsecond
    assert pose is not None
    assert pose.position == pytest.approx((10 * exact, 0, 0))
    assert 2 * math.atan2(pose.orientation[2], pose.orientation[3]) == pytest.approx(exact * yaw, abs=1e-9)


def test_before_the_first_sample_and_after_the_last_there_is_no_pose() -> None:
    queries = queried(a_pose(2, 2, 1, 0), until=3)
    assert queries.pose("a", "pose", at(1.999)) is None
    assert queries.pose("a", "pose", at(2.001)) is None
    assert queries.pose("a", "pose", at(2)) == Pose((1, 0, 0), (0, 0, 0, 1))
    assert queries.pose("b", "pose", at(2)) is None


@pytest.mark.parametrize(
    ("message", "at_path", "text"),
    [
        ({"speed": 3}, "", "no pose in the message: give its path with `at`"),
        ({"pose": {}}, "pose.pose", "no pose at 'pose.pose'"),
        ({"position": {"x": 1}}, "", "y of the pose is not a number: None"),
        ({"position": {"x": 1, "y": math.nan}}, "", "y of the pose is not a number: nan"),
        ({"position": {"x": 1, "y": 2}, "orientation": dict.fromkeys("xyzw", 0.0)}, "", "a quaternion of length zero"),
    ],
)
def test_a_message_without_a_pose_is_reported(message: Any, at_path: str, text: str) -> None:
    with pytest.raises(PoseError, match=text):
        pose_in(message, at_path)


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).map(unit).filter(lambda q: q is not None)
vectors = st.tuples(*[st.floats(-100, 100)] * 3)
poses = st.builds(Pose, vectors, quaternions)


@given(poses, poses, vectors)
def test_transforms_compose_and_have_an_inverse(a: Pose, b: Pose, point: Any) -> None:
    assert a.after(b).apply(point) == pytest.approx(a.apply(b.apply(point)), abs=1e-6)
    assert a.inverse().apply(a.apply(point)) == pytest.approx(point, abs=1e-6)


@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_stays_at_unit_length_and_turns_at_constant_speed(a: Any, b: Any, share: float) -> None:
    between = slerp(a, b, share)
    assert math.hypot(*between) == pytest.approx(1)

    def angle(p: Any, q: Any) -> float:
        return 2 * math.acos(min(1.0, abs(sum(x * y for x, y in zip(p, q, strict=True)))))

    assert angle(a, between) == pytest.approx(share * angle(a, b), abs=1e-3)


def brute_force(stamps: list[list[int]], slop: int) -> list[tuple[int, ...]]:
    """The definition, word by word."""

    def near(of: list[int], time: int) -> int:
        return min(range(len(of)), key=lambda i: (abs(of[i] - time), of[i], i))

    if not all(stamps):
        return []
    found = []
    for index, stamp in enumerate(stamps[0]):
        members = [index, *(near(of, stamp) for of in stamps[1:])]
        mutual = all(near(stamps[0], of[m]) == index for of, m in zip(stamps[1:], members[1:], strict=True))
        times = [of[m] for of, m in zip(stamps, members, strict=True)]
        if mutual and max(times) - min(times) <= slop:
            found.append(tuple(members))
    return found


@given(st.lists(st.lists(st.integers(0, 40), max_size=12).map(sorted), min_size=1, max_size=4), st.integers(0, 10))
def test_matched_tuples_follow_the_definition_and_share_no_sample(stamps: list[list[int]], slop: int) -> None:
    tuples = matched(stamps, slop)
    assert tuples == brute_force(stamps, slop)
    for stream in range(len(stamps)):
        members = [each[stream] for each in tuples]
        assert members == sorted(set(members))


@given(st.lists(st.integers(0, 40), min_size=1).map(sorted), st.integers(-5, 50))
def test_the_nearest_stamp_is_the_first_of_equally_near_ones(stamps: list[int], time: int) -> None:
    assert nearest_index(stamps, time) == min(range(len(stamps)), key=lambda i: (abs(stamps[i] - time), stamps[i], i))


def test_samples_of_two_streams_are_matched_by_stamp_whenever_they_came() -> None:
    poses = [a_pose(2 + n / 10, 1 + n / 10, n, 0) for n in range(4)]
    scans = [a_scan(25 + 2 * n, "a", stamp=1.02 + n * 0.2) for n in range(2)]
    queries = queried(*sorted([*poses, *scans]), until=4)
    tuples = queries.tuples("a", ["scan", "pose"], 30_000_000)
    assert [(s.message["n"], p.message["pose"]["position"]["x"]) for s, p in tuples] == [(25, 0), (27, 2)]
    assert queries.tuples("a", ["scan", "pose"], 10_000_000) == []
