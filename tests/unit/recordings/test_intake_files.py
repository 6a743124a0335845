"""Intake files read back in order, by Wayside and other tools, also after a kill -9."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from detector.engine.samples.sample import Arrival
from detector.replay.intake_file import Control, is_intake_file, read_intake
from detector.replay.intake_writer import IntakeWriter
from detector.replay.message import RecordingError
from detector.streams.codecs.ros import standard
from tests.ros_messages import cdr, pose_stamped
from wayside.api.stream import Encoding, Stream

POSE_TYPE = "geometry_msgs/msg/PoseStamped"
POSES = Stream(name="pose", key="vehicles/${client:*}/pose", encoding=Encoding.CDR, type=POSE_TYPE)
NOTES = Stream(name="notes", key="vehicles/${client:*}/note", encoding=Encoding.JSON)
POSE = cdr(pose_stamped())

START = Control(1, {"kind": "start", "rules": [{"a": "ü"}]})
CONSUMED: list[Arrival | Control] = [
    START,
    Arrival(10, "pose", "vehicles/car1/pose", POSE),
    Arrival(20, "notes", "vehicles/car1/note", b'{"text": 1}'),
    Control(15, {"kind": "gap"}),
    Arrival(12, "pose", "vehicles/car2/pose", POSE),
    Arrival(13, "other", "vehicles/car2/pose", b""),
    Control(30, {"kind": "end"}),
]


def write(path: Path, consumed: list[Arrival | Control], maximum_bytes: int = 2**28) -> IntakeWriter:
    writer = IntakeWriter(path, [POSES, NOTES], maximum_bytes=maximum_bytes)
    for item in consumed:
        if isinstance(item, Control):
            writer.control(item.time, item.document)
        else:
            writer.arrivals([item])
    writer.close()
    return writer


def test_everything_reads_back_in_the_order_in_which_it_was_consumed(tmp_path: Path) -> None:
    writer = write(tmp_path / "intake.mcap", CONSUMED)
    assert list(read_intake(tmp_path / "intake.mcap")) == CONSUMED
    assert (writer.lost, writer.error) == (0, None)


def test_many_samples_over_many_chunks_keep_their_order(tmp_path: Path) -> None:
    samples: list[Arrival | Control] = [
        Arrival(n, "pose", f"vehicles/car{n % 7}/pose", os.urandom(200)) for n in range(20_000)
    ]
    write(tmp_path / "intake.mcap", samples)
    assert list(read_intake(tmp_path / "intake.mcap")) == samples


def test_the_mcap_library_reads_the_messages_with_their_type(tmp_path: Path) -> None:
    write(tmp_path / "intake.mcap", CONSUMED)
    with (tmp_path / "intake.mcap").open("rb") as file:
        read = [
            (message.log_time, channel.topic, channel.message_encoding, schema and schema.name, message.data)
            for schema, channel, message in make_reader(file).iter_messages(
                ["vehicles/car1/pose", "vehicles/car1/note"]
            )
        ]
    assert read == [
        (10, "vehicles/car1/pose", "cdr", POSE_TYPE, POSE),
        (20, "vehicles/car1/note", "json", None, b'{"text": 1}'),
    ]


def test_rosbags_reads_the_messages_with_their_type(tmp_path: Path) -> None:
    write(tmp_path / "intake.mcap", CONSUMED)
    with Reader(tmp_path / "intake.mcap") as reader:
        poses = [connection for connection in reader.connections if connection.msgtype == POSE_TYPE]
        assert [(time, raw) for _, time, raw in reader.messages(poses)] == [(10, POSE), (12, POSE)]
        assert "geometry_msgs/Pose pose" in poses[0].msgdef.data


def test_a_stream_whose_type_changes_continues_in_another_channel(tmp_path: Path) -> None:
    path = tmp_path / "intake.mcap"
    writer = IntakeWriter(path, [POSES])
    first = Arrival(1, "pose", "vehicles/car1/pose", POSE)
    writer.arrivals([first])
    writer.follow([Stream(name="pose", key="vehicles/${client:*}/pose", encoding=Encoding.JSON)], standard())
    second = Arrival(2, "pose", "vehicles/car1/pose", b"{}")
    writer.arrivals([second])
    writer.close()
    assert list(read_intake(path)) == [first, second]
    with path.open("rb") as file:
        assert [channel.message_encoding for _, channel, _ in make_reader(file).iter_messages()] == ["cdr", "json"]


@settings(max_examples=100, deadline=None)
@given(cut=st.integers(0, 10_000))
def test_a_truncated_file_is_read_up_to_the_cut_and_reported(
    cut: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "whole.mcap"
    if not path.exists():
        write(path, CONSUMED)
    whole = path.read_bytes()
    cut_path = path.with_name("cut.mcap")
    cut_path.write_bytes(whole[: cut % len(whole)])
    if not is_intake_file(cut_path):
        assert cut % len(whole) < 100  # not even the header is there
        return
    read = list(read_intake(cut_path))
    last = read[-1]
    if isinstance(last, Control) and last.kind == "cut":
        assert last.document["reason"]
        read.pop()
    else:
        assert len(read) == len(CONSUMED)
    assert read == CONSUMED[: len(read)]


def test_a_killed_writer_leaves_all_samples_up_to_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "intake.mcap"
    program = f"""
import sys, time
from pathlib import Path
from detector.engine.samples.sample import Arrival
from detector.replay.intake_writer import IntakeWriter
writer = IntakeWriter(Path({str(path)!r}))
number = 0
while True:
    writer.arrivals([Arrival(number, "pose", "key", b"payload")])
    print(number, flush=True)
    number += 1
    time.sleep(0.02)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        taken: list[tuple[float, int]] = []
        longest = 0.0  # between two lines: by how much a slow machine may be late
        for line in process.stdout:
            now = time.monotonic()
            longest = max([longest, *(now - before for before, _ in taken[-1:])])
            taken.append((now, int(line)))
            if now > taken[0][0] + 2.2 + 10 * longest:
                process.send_signal(signal.SIGKILL)
                break
    killed = taken[-1][0]
    *arrivals, last = read_intake(path)
    assert isinstance(last, Control)
    assert last.kind == "cut"
    assert [arrival.received for arrival in arrivals] == list(range(len(arrivals)))
    due = [number for when, number in taken if when < killed - 1.5 - 5 * longest]
    assert len(arrivals) > due[-1]


def test_samples_beyond_the_queue_are_counted_and_their_place_is_marked(tmp_path: Path) -> None:
    writer = write(tmp_path / "intake.mcap", [START, Arrival(5, "pose", "k", b"x" * 1000), CONSUMED[-1]], 900)
    assert writer.lost == 1
    assert list(read_intake(tmp_path / "intake.mcap")) == [
        START,
        Control(5, {"kind": "lost", "arrivals": 1}),
        CONSUMED[-1],
    ]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_ends_the_recording_but_not_the_caller(caplog: pytest.LogCaptureFixture) -> None:
    writer = write(Path("/dev/full"), CONSUMED)
    assert writer.error is not None
    writer.arrivals([Arrival(1, "pose", "k", b"")])
    assert writer.lost > 0
    assert "No space left" in caplog.text
    assert "intake-writer" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"{}\n", b"\x00" * 100])
def test_other_files_are_rejected_as_intake_files(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    assert not is_intake_file(path)
    with pytest.raises(RecordingError, match="not an intake file"):
        list(read_intake(path))
