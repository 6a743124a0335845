"""Recordings and messages that other programs wrote: messages of another CDR encoder replay, and ours read there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

from detector.assembly import stream_readers
from detector.engine.samples.sample import Arrival
from detector.replay.intake_writer import IntakeWriter
from detector.replay.playing import recorded_arrivals
from detector.replay.recorded_types import with_recorded_types
from detector.replay.replaying import replay_arrivals
from detector.replay.routing import MessageRouter
from tests.driving import a_detector, a_rule, at, reported
from tests.recorded import messages_in
from tests.ros_messages import cdr, odometry

OBSTACLES = "lab_msgs/msg/Obstacles"
DEFINITION = """\
float64 range
std_msgs/Header header
Obstacle[] obstacles
================================================================================
MSG: lab_msgs/Obstacle
string label
float32[3] size
int64 id
bool moving
geometry_msgs/Point[<=4] outline
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
STREAM = {"name": "obstacles", "key": "${client:*}/obstacles", "encoding": "cdr", "type": OBSTACLES}


def obstacles(count: int, seconds: int) -> dict[str, Any]:
    return {
        "range": 50.5,
        "header": {"stamp": {"sec": 1_767_225_600 + seconds, "nanosec": 1}, "frame_id": "map"},
        "obstacles": [
            {
                "label": "x" * number,  # so that what follows has to be aligned
                "size": [1.0, 2.0, 0.5],
                "id": 2**53 + 1 + number,
                "moving": bool(number % 2),
                "outline": [{"x": 1.0, "y": float(corner), "z": 0.0} for corner in range(number)],
            }
            for number in range(count)
        ],
    }


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Written by mcap-ros2-support, which has an encoder of its own."""
    path = tmp_path / "drive.mcap"
    writer = Writer(str(path))
    schema = writer.register_msgdef(OBSTACLES, DEFINITION)
    for second in range(5):
        writer.write_message("/car/obstacles", schema, obstacles(second, second), log_time=at(second + 0.5))
    writer.finish()
    return path


def test_messages_of_another_encoder_read_as_they_were_written(recording: Path) -> None:
    completed = with_recorded_types(a_detector(STREAM), [recording])
    decoder = stream_readers(completed).decoders["obstacles"]
    messages = [message.payload for message in messages_in([recording])]
    assert [decoder.decode(raw) for raw in messages] == [obstacles(second, second) for second in range(5)]
    assert [decoder.stamp(raw) for raw in messages] == [at(second) + 1 for second in range(5)]


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_a_recording_of_another_program_replays(recording: Path, clock: str) -> None:
    rule = a_rule("crowd", signals=[{"name": "n", "stream": "obstacles", "value": "size(msg.obstacles)"}], when="n > 2")
    completed = with_recorded_types(a_detector(STREAM, clock=clock, lateness="0ms"), [recording])
    arrivals = recorded_arrivals([recording], MessageRouter(completed.spec.streams), completed)
    events = reported(replay_arrivals(arrivals, completed, [rule]).events)
    assert events == ["crowd car started 4"]


def test_recordings_are_readable_by_other_programs(tmp_path: Path) -> None:
    stream = {"name": "odom", "key": "${client:*}/odom", "encoding": "cdr", "type": "nav_msgs/msg/Odometry"}
    detector = a_detector(stream)
    writer = IntakeWriter(tmp_path / "intake.mcap", detector.spec.streams, stream_readers(detector).types)
    writer.arrivals([Arrival(5, "odom", "car/odom", cdr(odometry()))])
    writer.close()
    with (tmp_path / "intake.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        ((_, _, _, message),) = reader.iter_decoded_messages(["car/odom"])
    assert message.child_frame_id == "base"
    assert message.twist.twist.linear.y == 2.0
