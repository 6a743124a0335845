"""The transform tree of a client: chains, interpolation, static transforms, prefixes, and unknown transforms."""

from __future__ import annotations

import math
from typing import Any

import pytest

from detector.engine.queries.geometry import Pose
from detector.engine.queries.transforms import TransformError
from detector.engine.samples.sample import Arrival
from tests.driving import START, Drive, a_detector, at
from tests.ros_messages import cdr, header, make
from wayside.api import Detector

FIRST = START // 10**9


def tf_stream(name: str, **fields: Any) -> dict[str, Any]:
    return {
        "name": name,
        "key": f"${{client:*}}/{name}",
        "encoding": "cdr",
        "type": "tf2_msgs/msg/TFMessage",
        **fields,
    }


DETECTOR = a_detector(tf_stream("tf"), tf_stream("tf-static", latched=True), buffer={"duration": "10s"})


def transform(parent: str, child: str, stamp: float, x: float, y: float = 0.0, yaw: float = 0.0) -> Any:
    whole = math.floor(stamp)
    return make(
        "geometry_msgs/TransformStamped",
        header=header(FIRST + whole, round((stamp - whole) * 1e9), parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/Transform",
            translation=make("geometry_msgs/Vector3", x=x, y=y, z=0.0),
            rotation=make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)),
        ),
    )


def tf(seconds: float, *transforms: Any, stream: str = "tf", client: str = "car") -> Arrival:
    payload = cdr(make("tf2_msgs/TFMessage", transforms=list(transforms)))
    return Arrival(at(seconds), stream, f"{client}/{stream}", payload)


def driven(*arrivals: Arrival, until: float = 2.0, detector: Detector = DETECTOR) -> Drive:
    drive = Drive(detector)
    drive.take(*arrivals, until=until)
    return drive


def place(drive: Drive, target: str, source: str, seconds: float | None, client: str = "car") -> Any:
    pose = drive.engine.queries().transform(client, target, source, None if seconds is None else at(seconds))
    return tuple(round(value, 6) for value in pose.position)


MOVING = [
    tf(1.0, transform("map", "base", 1, x=10)),
    tf(1.1, transform("base", "lidar", 0, x=2, yaw=math.pi / 2), stream="tf-static"),
    tf(1.2, transform("base", "camera", 0, x=1), stream="tf-static"),
    tf(1.5, transform("map", "base", 1.5, x=20)),
]


def test_chains_go_up_to_the_common_ancestor_and_down_again() -> None:
    drive = driven(*MOVING)
    assert place(drive, "map", "lidar", 1.5) == (22, 0, 0)
    assert place(drive, "lidar", "map", 1.5) == (0, 22, 0)
    assert place(drive, "camera", "lidar", 1.5) == (1, 0, 0)
    assert drive.engine.queries().transform("car", "map", "lidar", at(1.5)).apply((1, 0, 0)) == pytest.approx(
        (22, 1, 0)
    )
    assert drive.engine.queries().transform("car", "x", "x") == Pose((0, 0, 0), (0, 0, 0, 1))


def test_between_stamps_a_transform_is_interpolated() -> None:
    drive = driven(*MOVING)
    assert place(drive, "map", "base", 1.1) == (12, 0, 0)
    assert place(drive, "map", "lidar", 1.25) == (17, 0, 0)


def test_without_a_time_the_newest_common_stamp_of_the_chain_is_used() -> None:
    drive = driven(*MOVING, tf(1.6, transform("world", "map", 1.2, x=100)))
    assert place(drive, "map", "base", None) == (20, 0, 0)
    with pytest.raises(TransformError, match="before the first"):
        place(drive, "world", "base", 1.1)
    assert place(drive, "world", "base", None) == (114, 0, 0)
    assert place(drive, "base", "camera", None) == (1, 0, 0)


def test_beyond_the_stamps_the_transform_is_unknown_and_the_times_are_reported() -> None:
    drive = driven(*MOVING)
    with pytest.raises(TransformError) as error:
        place(drive, "map", "lidar", 1.75)
    assert str(error.value) == (
        f"client car has no transform from frame 'map' to 'base' at {FIRST + 1}.750000000, which is 0.250 s after the "
        f"last transform: these frames have transforms from {FIRST + 1}.000000000 to {FIRST + 1}.500000000"
    )
    assert place(drive, "camera", "lidar", 1.75) == (1, 0, 0)  # what moves is not on the way


def test_unknown_and_unconnected_frames_are_distinguished() -> None:
    drive = driven(*MOVING, tf(1.7, transform("room", "chair", 1.7, x=0)))
    with pytest.raises(TransformError, match=r"client car has no frame 'lidr': did you mean 'lidar'\?"):
        place(drive, "map", "lidr", 1.5)
    with pytest.raises(
        TransformError, match="'map' and 'chair' of client car are not connected: one chain ends at 'map'"
    ):
        place(drive, "map", "chair", 1.7)
    with pytest.raises(TransformError, match="no transforms of it have arrived"):
        place(drive, "map", "base", 1.5, client="bus")


def test_a_cycle_of_frames_is_reported() -> None:
    drive = driven(tf(1, transform("a", "b", 1, x=0), transform("b", "a", 1, x=0)))
    with pytest.raises(TransformError, match="cycle"):
        place(drive, "c", "a", 1)


def test_a_frame_keeps_its_old_parent_until_the_change() -> None:
    drive = driven(
        tf(1.0, transform("map", "a", 0, x=100), transform("map", "b", 0, x=200), stream="tf-static"),
        tf(1.1, transform("a", "load", 1.0, x=1)),
        tf(1.2, transform("b", "load", 2.0, x=2)),
    )
    assert place(drive, "map", "load", 1.9) == (101, 0, 0)
    assert place(drive, "map", "load", 2.0) == (202, 0, 0)


def test_static_transforms_of_several_publishers_outlive_the_buffer_and_are_replaced() -> None:
    drive = driven(*MOVING, until=2)
    drive.take(tf(60, transform("map", "base", 60, x=0)), until=60)
    assert place(drive, "lidar", "camera", None) == (0, 1, 0)
    drive.take(tf(61, transform("base", "camera", 61, x=5), stream="tf-static"), until=100)
    drive.take(tf(100.5, transform("map", "base", 100, x=0)), until=101)
    assert place(drive, "base", "camera", None) == (5, 0, 0)
    assert place(drive, "base", "lidar", None) == (2, 0, 0)
    assert sum(len(lane.samples) for lane in drive.engine.buffer if lane.stream == "tf-static") == 2


def test_frame_prefixes_are_removed_and_each_client_has_its_own_tree() -> None:
    detector = a_detector(tf_stream("tf", framePrefix="${client}/"))
    drive = driven(
        tf(1, transform("map", "car/base", 1, x=1)),
        tf(1.1, transform("map", "bus/base", 1, x=2), client="bus"),
        detector=detector,
    )
    assert place(drive, "map", "base", 1) == place(drive, "map", "car/base", 1) == place(drive, "/map", "base", 1)
    assert place(drive, "map", "base", 1, client="bus") == (2, 0, 0)


def test_an_invalid_transform_is_skipped_and_counted_once() -> None:
    bad = transform("base", "arm", 1, x=math.nan)
    drive = driven(*MOVING, tf(1.8, bad, transform("base", "leg", 1, x=3)))
    assert place(drive, "base", "leg", 1) == place(drive, "base", "leg", None) == (3, 0, 0)
    with pytest.raises(TransformError, match="no frame 'arm'"):
        place(drive, "base", "arm", 1)
    assert drive.engine.counters.undecodable["tf"] == 1


def test_transforms_later_than_the_tick_are_not_seen() -> None:
    drive = driven(*MOVING, until=1.5)
    drive.take(tf(1.6, transform("map", "base", 1.6, x=99)), until=1.59)
    with pytest.raises(TransformError):
        drive.engine._inputs.transforms.lookup("car", "map", "base", at(1.6), at(1.55))


def test_decoded_transforms_are_dropped_after_use() -> None:
    drive = driven(*MOVING)
    assert place(drive, "map", "base", 1.5) == (20, 0, 0)
    transforms = drive.engine._inputs.transforms
    assert len(transforms._parsed) == 2
    drive.take(until=11)
    assert len(transforms._parsed) == 2
    drive.take(until=13)
    assert not transforms._parsed
    assert not transforms._used
