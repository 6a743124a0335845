"""Signals of lists and bytes in the engine: two outputs of one scene compared, images, raw numbers."""

from __future__ import annotations

import time
import zlib

import numpy as np
from rosbags.typesys import Stores, get_typestore

from detector.engine.samples.sample import Arrival
from tests.driving import POSITION, Drive, a_detector, a_rule, a_stream, an_engine, arrival, at, reported

COMPARED = a_rule(
    signals=[
        {"name": "camera", "stream": "camera", "value": "msg.objects"},
        {"name": "lidar", "stream": "lidar", "value": "msg.objects"},
    ],
    when="countUnmatched(camera, lidar, 2) >= 1",
)


def objects(*places: tuple[float, float]) -> dict[str, object]:
    return {"objects": [{"id": index, "x": x, "y": y} for index, (x, y) in enumerate(places)]}


def test_two_perception_outputs_of_a_scene_are_compared_in_one_rule() -> None:
    drive = Drive(a_detector(a_stream("camera"), a_stream("lidar")), COMPARED)
    both = [arrival(0.5, "rsu", objects((0, 0), (10, 0)), stream) for stream in ("camera", "lidar")]
    assert drive.take(*both, until=1) == []
    moved = arrival(1.5, "rsu", objects((0, 1), (10, 3)), "lidar")
    assert drive.take(moved, until=2) == ["r rsu started 2"]
    assert drive.events[0].values["lidar"][1] == {"id": 1.0, "x": 10.0, "y": 3.0}
    broken = arrival(2.5, "rsu", {"objects": [{"id": 1, "x": None, "y": 3}]}, "lidar")
    assert drive.take(broken, until=3) == []  # unknown: nothing ends
    assert drive.take(arrival(3.5, "rsu", objects((0, 0), (9, 0)), "lidar"), until=4) == ["r rsu Until 4"]


def test_object_lists_of_two_vehicles_are_compared_in_a_pair() -> None:
    rule = a_rule(
        scope={"pairs": {"position": POSITION, "within": 100}},
        signals=[{"name": "seen", "stream": "camera", "value": "msg.objects"}],
        when="countUnmatched(a.seen, b.seen, 2) + countUnmatched(b.seen, a.seen, 2) > 0",
    )
    drive = Drive(a_detector(a_stream("camera"), a_stream("pose")), rule)
    poses = [arrival(0.1, car, {"x": x, "y": 0}, "pose") for car, x in (("car1", 0), ("car2", 50))]
    same = [arrival(0.2, car, objects((20, 0), (30, 0)), "camera") for car in ("car1", "car2")]
    assert drive.take(*poses, *same, until=1) == []
    assert drive.take(arrival(1.5, "car2", objects((20, 1)), "camera"), until=2) == ["r car1+car2 started 2"]


def test_functions_handle_object_lists_too_long_for_cel_loops() -> None:
    many = [(float(x), float(y)) for x in range(120) for y in range(120)]  # more than 10,000
    drive = Drive(a_detector(a_stream("camera"), a_stream("lidar"), buffer={"bytes": "1Gi"}), COMPARED)
    drive.take(arrival(0.5, "rsu", objects(*many, (500, 0)), "camera"), until=0.9)
    assert drive.take(arrival(0.6, "rsu", objects(*many), "lidar"), until=1) == ["r rsu started 1"]


def test_an_image_of_a_million_bytes_is_evaluated_without_becoming_a_list() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    detector = a_detector(
        {"name": "image", "key": "v/${client:*}/image", "encoding": "cdr", "type": "sensor_msgs/msg/Image"}
    )
    rule = a_rule(
        signals=[
            {"name": "dark", "stream": "image", "value": "allZero(msg.data)"},
            {"name": "frozen", "stream": "image", "value": "checksum(msg.data)", "over": "9s", "aggregate": "Distinct"},
            {"name": "image", "stream": "image", "value": "msg.data"},
        ],
        when="dark && size(frozen) == 1 && byteCount(image) == 1e6",
    )  # fmt: skip

    def payload(data: np.ndarray[tuple[int], np.dtype[np.uint8]]) -> bytes:
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 0), "camera")
        message = types["sensor_msgs/msg/Image"](header, 1000, 1000, "mono8", 0, 1000, data)
        return bytes(store.serialize_cdr(message, "sensor_msgs/msg/Image"))

    engine = an_engine(detector, rule)
    dark, lit = np.zeros(10**6, np.uint8), np.zeros(10**6, np.uint8)
    lit[-1] = 1
    arrivals = [Arrival(at(0.1 * i), "image", "v/car/image", payload(dark)) for i in range(1, 11)]
    begin = time.thread_time()  # of this thread: others may have work of their own
    events = engine.advance(arrivals, at(1))
    events += engine.advance([Arrival(at(1.5), "image", "v/car/image", payload(lit))], at(2))
    spent = time.thread_time() - begin
    assert reported(events) == ["r car started 1", "r car Until 2"]
    assert events[0].values == {"dark": True, "frozen": [float(zlib.crc32(dark.tobytes()))], "image": None}
    assert spent < 2.0, "eleven images as lists of doubles, for three signals, would take several times this"


def test_a_raw_payload_is_read_by_functions() -> None:
    detector = a_detector({"name": "can", "key": "v/${client:*}/can", "encoding": "raw"})
    rule = a_rule(
        signals=[
            {"name": "rpm", "stream": "can", "value": 'numberAt(msg, 3, "u16be") / 8', "where": "byteCount(msg) == 5"}
        ],
        when="rpm > 4000",
    )
    engine = an_engine(detector, rule)
    frames = [b"\0\1\0" + (8 * 4500).to_bytes(2, "big"), b"\0"]
    arrivals = [Arrival(at(0.1 * i + 0.1), "can", "v/car/can", frame) for i, frame in enumerate(frames)]
    events = engine.advance(arrivals, at(1))
    assert reported(events) == ["r car started 1"]
    assert events[0].values == {"rpm": 4500.0}
