"""unmatched-objects: objects that one perception sees and the other does not, in one client and between two."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.samples.sample import Arrival
from detector.plugins.entrypoints import PluginError
from detector.plugins.instances import LocalHost, prepare_plugin
from detector.plugins.unmatched import Tracks, assigned
from tests.driving import a_detector, a_rule, a_stream, arrival, at
from tests.plugins.rules import PluginDrive
from tests.ros_messages import cdr, header, make, pose
from tests.unit.signals.test_transforms import FIRST, tf, tf_stream, transform
from wayside.api import EventRule

points = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=4)


@settings(deadline=None)  # the first call imports scipy
@given(points, points, st.integers(1, 4))
def test_the_matching_has_the_most_pairs_and_of_these_the_nearest(first: Any, second: Any, gate: int) -> None:
    found = assigned(first, second, gate)
    assert len(set(found.values())) == len(found)
    assert all(math.dist(first[a], second[b]) <= gate for a, b in found.items())
    few, many = (first, second) if len(first) <= len(second) else (second, first)
    ways = []
    for chosen in itertools.permutations(range(len(many)), len(few)):
        distances = [math.dist(few[i], many[j]) for i, j in enumerate(chosen)]
        within = [distance for distance in distances if distance <= gate]
        ways.append((-len(within), sum(within)))
    count, cost = min(ways)
    assert -len(found) == count
    assert sum(math.dist(first[a], second[b]) for a, b in found.items()) == pytest.approx(cost)


def test_a_track_lasts_while_it_is_matched_and_restarts_after_a_gap() -> None:
    tracks = Tracks(1.0, 10.0, 3)
    tracks.follow([(0.0, 0.0), (50.0, 0.0)], 1)
    tracks.follow([(0.5, 0.0)], 2)
    assert [(track.place, track.since) for track in tracks.lasting(2, 0)] == [((0.5, 0.0), 1)]
    tracks.follow([(0.5, 0.0), (50.0, 0.0)], 3)  # gone for 2 of 3 ns
    assert [track.since for track in tracks.lasting(3, 0)] == [1, 1]
    tracks.follow([(0.5, 0.0)], 6)
    tracks.follow([(0.5, 0.0), (50.0, 0.0)], 7)
    assert [track.since for track in tracks.lasting(7, 0)] == [1, 7]
    assert [track.since for track in tracks.lasting(7, 6)] == [1]


def a_list(seconds: float, client: str, stream: str, *places: tuple[float, Any], **fields: Any) -> Arrival:
    value = {"t": at(seconds) / 1e9, "objects": [{"x": x, "y": y} for x, y in places], **fields}
    return arrival(seconds + 0.05, client, value, stream)


def rule(scope: dict[str, Any] | None = None, **parameters: Any) -> EventRule:
    plugin = {"name": "unmatched-objects", "parameters": {"objects": {"stream": "camera"}, **parameters}}
    return a_rule(
        signals=[{"name": "unmatched", "plugin": plugin}],
        when="size(unmatched) > 0",
        scope=scope or {"client": {}},
        evaluation={"every": "500ms"},
    )


STAMPED = a_stream("camera", stamp="msg.t"), a_stream("lidar", stamp="msg.t")
LIDAR = {"stream": "lidar"}


def drive(rule: EventRule, *streams: Any) -> PluginDrive:
    return PluginDrive(a_detector(*(streams or STAMPED), clientTimeout="1h"), rule, host=LocalHost())


def test_objects_missed_by_the_other_perception_for_long_enough_are_reported() -> None:
    driven = drive(rule(counterparts=LIDAR, persist=1))
    for n in range(6):
        seconds = 0.3 + n / 2
        ghost = [(30.0, 0.0 + n)] if n >= 1 else []
        driven.take(a_list(seconds, "a", "camera", (0.2, 0), (10, 0), *ghost), until=seconds + 0.05)
        driven.take(a_list(seconds + 0.03, "a", "lidar", (0, 0), (10, 1)), until=seconds + 0.1)
    assert driven.take(until=3) == []
    assert [event.episode.start_time for event in driven.events] == [at(2)]
    assert driven.events[0].values["unmatched"] == [{"x": 30.0, "y": 3.0, "seconds": 1.0}]


def test_a_new_counterpart_ends_the_episode_and_lists_of_different_times_are_not_compared() -> None:
    driven = drive(rule(counterparts=LIDAR, persist=0))
    driven.take(a_list(0.2, "a", "camera", (0, 0)), a_list(0.35, "a", "lidar", (50, 0)), until=0.5)
    assert not driven.events
    assert driven.take(a_list(0.6, "a", "camera", (0, 0)), a_list(0.6, "a", "lidar"), until=1) == ["r a started 1"]
    assert driven.take(a_list(1.2, "a", "camera", (0, 0)), a_list(1.2, "a", "lidar", (1, 0)), until=2) == [
        "r a Until 1.5"
    ]


PAIRS = {"pairs": {"position": {"stream": "pose", "x": "msg.pose.position.x", "y": "0.0"}, "within": 100}}


def odometry(seconds: float, client: str, x: float, yaw: float) -> Arrival:
    place = pose(x, 0.0)
    place.orientation.z, place.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    stamp = header(FIRST + int(seconds), round(seconds % 1 * 1e9))
    payload = cdr(make("geometry_msgs/PoseStamped", header=stamp, pose=place))
    return Arrival(at(seconds) + 1, "pose", f"vehicles/{client}/pose", payload)


@pytest.mark.parametrize(("of", "expected"), [("a", (15.0, 0.0)), ("b", (40.0, 0.0))])
def test_positions_of_two_clients_are_transformed_by_their_poses(of: Any, expected: Any) -> None:
    streams = STAMPED[0], a_stream("pose", encoding="cdr", type="geometry_msgs/msg/PoseStamped")
    placed = {"stream": "camera", "pose": {"stream": "pose"}}
    driven = drive(rule(PAIRS, objects=placed, persist=0, of=of), *streams)
    # a stands at 0 and looks along x; b stands at 20 and looks back. Both see what is at 10.
    for seconds in (0.1, 0.5):
        driven.take(odometry(seconds, "a", 0, 0), odometry(seconds + 1e-6, "b", 20, math.pi), until=seconds + 0.01)
    driven.take(a_list(0.3, "a", "camera", (10, 0), (15, 0)), a_list(0.33, "b", "camera", (10, 0), (-20, 0)), until=1)
    (event,) = driven.events
    (found,) = event.values["unmatched"]
    assert (found["x"], found["y"]) == pytest.approx(expected)


def test_with_a_frame_positions_are_transformed_by_tf_once_it_is_known() -> None:
    objects = {"stream": "camera", "frame": "map"}
    counterparts = {"stream": "lidar", "frame": "map"}
    driven = drive(rule(objects=objects, counterparts=counterparts, persist=0), *STAMPED, tf_stream("tf"))
    cameras = a_list(0.4, "a", "camera", (1, 0), (5, 0), header={"frame_id": "base"})
    lidars = a_list(0.4, "a", "lidar", (11, 0), header={"frame_id": "map"})
    driven.take(tf(0.3, transform("map", "base", 0.3, x=10), client="a"), cameras, lidars, until=0.5)
    assert "after the last transform" in driven.engine.counters.rule("r").last_error
    later = tf(0.6, transform("map", "base", 0.5, x=10), client="a")
    assert driven.take(later, until=1) == ["r a started 1"]
    assert driven.events[0].values["unmatched"][0]["x"] == pytest.approx(15)


def test_objects_without_a_position_are_skipped_and_a_message_without_a_list_is_an_error() -> None:
    driven = drive(rule(counterparts=LIDAR, persist=0))
    driven.take(a_list(0.2, "a", "camera", (1, None)), a_list(0.2, "a", "lidar"), until=1)
    assert not driven.events
    driven.take(a_list(1.2, "a", "camera"), a_list(1.2, "a", "lidar", objects=3), until=1.5)
    assert "a message of stream lidar has no list at 'objects'" in driven.engine.counters.rule("r").last_error


def test_while_a_stream_is_stale_nothing_is_known() -> None:
    stale = [{**stream, "staleAfter": "1s"} for stream in STAMPED]
    driven = drive(rule(counterparts=LIDAR, persist=0), *stale)
    started = driven.take(a_list(0.2, "a", "camera", (1, 0)), a_list(0.2, "a", "lidar"), until=0.5)
    assert started == ["r a started 0.5"]
    driven.take(until=2)
    assert any("returned no value" in text for text in driven.engine.counters.rule("r").absences)


@pytest.mark.parametrize(
    ("parameters", "reported"),
    [
        ({}, "is missing"),
        ({"objects": {"stream": "radar"}}, "no stream radar"),
        ({"objects": {"stream": "camera", "frame": "m", "pose": {"stream": "camera"}}}, "give frame"),
        ({"objects": {"stream": "camera"}, "within": 0}, "greater than 0"),
        ({"objects": {"stream": "camera"}, "of": "c"}, "'a' or 'b'"),
    ],
)
def test_invalid_parameters_are_rejected(parameters: dict[str, Any], reported: str) -> None:
    with pytest.raises(PluginError, match=reported):
        prepare_plugin("unmatched-objects", parameters, ["camera", "lidar"])
