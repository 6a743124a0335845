"""`detector topics` and `detector check --recording`: keys, fields and warnings from recordings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cbor2
import pytest
import yaml
from mcap.writer import Writer
from typer.testing import CliRunner

from detector.commands.cli import app
from detector.commands.topics.proposal import proposals
from detector.commands.topics.survey import Topic, encoding_of, topic_shape
from tests.ros_messages import cdr, odometry
from wayside.api.stream import Encoding

START = 1_700_000_000_000_000_000
SECOND = 10**9


def ran(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [*map(str, arguments)])


def drive(folder: Path, *messages: tuple[float, str, object], name: str = "drive.jsonl") -> Path:
    path = folder / name
    lines = ({"t": START + round(at * SECOND), "key": key, "value": value} for at, key, value in messages)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def two_cars(folder: Path) -> Path:
    messages = [
        (at / 10 + (5 if at >= 50 else 0), f"vehicles/{car}/odom", {"v": at, "pose": {"x": 1.5}, "seen": [{"id": 7}]})
        for at in range(100)
        for car in ("car1", "car2")
    ]
    return drive(folder, *messages, (15.5, "vehicles/car1/state", {"gear": "D", "door": None}))


def topic(key: str, *samples: bytes, recorded_as: str = "", kind: str | None = None) -> Topic:
    found = Topic(key, recorded_as, kind, None)
    for number, sample in enumerate(samples or (b"{}",)):
        found.add(START + number * SECOND, sample)
    return found


def test_topics_lists_keys_clients_rate_gap_and_fields(tmp_path: Path) -> None:
    result = ran("topics", two_cars(tmp_path))
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert lines[0] == "vehicles/${client:*}/odom"
    for words in ("json", "2 clients: car1, car2", "200 messages", "gap 5.1 s of vehicles/car1/odom at 22:13:24.900"):
        assert words in lines[1]
    assert [line.split()[0] for line in lines[2:5]] == ["msg.v", "msg.pose.x", "msg.seen[0].id"]
    assert {line.split()[1] for line in lines[2:5]} == {"number"}
    assert lines[5] == "vehicles/${client:*}/state"
    assert ["msg.door", "null"] in [line.split() for line in lines[6:]]


def test_the_proposed_detector_is_right_and_takes_all_messages(tmp_path: Path) -> None:
    recording = two_cars(tmp_path)
    proposed = tmp_path / "detector.yaml"
    proposed.write_text(ran("topics", recording, "--yaml").output)
    assert ran("check", proposed, "--recording", recording).exit_code == 0
    result = ran("replay", recording, "--detector", proposed, "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "201 samples" in result.output


def test_ros_messages_are_listed_by_their_type_and_can_be_taken(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", b"")
        channel = writer.register_channel("/odom", "cdr", schema)
        for step in range(20):
            at = START + step * SECOND // 10
            writer.add_message(channel, at, cdr(odometry()), at)
        writer.finish()
    result = ran("topics", path)
    assert result.exit_code == 0, result.output
    first, second = result.output.splitlines()[:2]
    assert first == "odom"
    assert "cdr (nav_msgs/msg/Odometry), 20 messages, 10 Hz, longest gap 0.1 s of odom" in second
    assert "msg.twist.twist.linear.x" in result.output.split()
    document = yaml.safe_load(ran("topics", path, "--yaml").output)
    kind = {"encoding": "cdr", "type": "nav_msgs/msg/Odometry"}
    (stream,) = document["spec"]["streams"]
    assert stream == {"name": "odom", "key": "odom", "client": "vehicle", **kind, "staleAfter": "1s"}


def test_encodings_that_a_recording_does_not_name_are_found_by_looking() -> None:
    assert encoding_of(topic("a", b'{"v": 1}')) is Encoding.JSON
    assert encoding_of(topic("a", cbor2.dumps({"v": 1}))) is Encoding.CBOR
    assert encoding_of(topic("a", b"\xff\xd8\xff\xe0", b"\x01\x02\x03")) is Encoding.RAW
    assert topic_shape(topic("a", b"\x01\x02\x03")) is None


@pytest.mark.parametrize(
    ("keys", "patterns"),
    [
        (["odom", "imu"], ["odom", "imu"]),
        (["car1/odom", "car2/odom"], ["${client:*}/odom"]),
        (["v/car1/cam/a", "v/car1/cam/b", "v/car2/cam/a"], ["v/${client:*}/cam/a", "v/${client:*}/cam/b"]),
        (["odom/car1", "odom/car2", "fix/car1"], ["odom/${client:*}", "fix/${client:*}"]),
    ],
)
def test_the_client_is_the_chunk_in_which_keys_differ(keys: Sequence[str], patterns: Sequence[str]) -> None:
    found = proposals([topic(key, b'{"%s": 1}' % key.replace("car1", "").replace("car2", "").encode()) for key in keys])
    assert [each.key for each in found] == patterns
    assert len({each.name for each in found}) == len(found)


def test_a_slow_stream_is_proposed_with_a_staleness_that_fits() -> None:
    slow = Topic("battery", "json", None, None)
    for step in range(5):
        slow.add(START + step * 10 * SECOND, b"{}")
    assert proposals([slow])[0].document()["staleAfter"] == "30s"


def test_a_long_recording_is_looked_at_evenly() -> None:
    found = topic("a", *(b'{"v": %d}' % number for number in range(5000)))
    assert found.count == 5000
    assert 200 < len(found.samples) <= 512
    assert json.loads(found.samples[-1])["v"] > 4900


def test_a_recording_without_messages_is_an_error(tmp_path: Path) -> None:
    result = ran("topics", drive(tmp_path))
    assert result.exit_code != 0
    assert "contains no message" in str(result.exception)


# detector check --recording

DETECTOR = """
apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: desk}
spec:
  mode: Standalone
  streams:
    - {name: odom, key: 'vehicles/${client:*}/odom', encoding: json}
    - {name: state, key: 'vehicles/${client:*}/status', encoding: json}
"""
RULE = """
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: fast}
spec:
  signals:
    - {name: v, stream: odom, value: msg.v}
    - {name: x, stream: odom, value: msg.pose.X}
  when: v > 50 && x > 0
"""


def checked(folder: Path, detector: str, rule: str) -> Any:
    (folder / "detector.yaml").write_text(detector)
    (folder / "rules.yaml").write_text(rule)
    files = folder / "detector.yaml", folder / "rules.yaml"
    return ran("check", *files, "--recording", two_cars(folder))


def test_a_misspelt_field_of_json_is_found_at_its_place(tmp_path: Path) -> None:
    result = checked(tmp_path, DETECTOR, RULE)
    where = "rules.yaml:8:38: warning: spec.signals[1].value"
    assert f"{where}: in the recording, msg.pose has no field X;" in result.output
    assert "(stream odom)" in result.output
    assert " [field-not-recorded]" in result.output
    assert result.exit_code == 0  # a warning: another recording may have it


def test_a_stream_that_matches_nothing_is_found_with_the_keys_that_there_are(tmp_path: Path) -> None:
    result = checked(tmp_path, DETECTOR, RULE.replace("msg.pose.X", "msg.pose.x"))
    assert (
        "spec.streams[1].key: no message of the recording belongs to stream state; its keys are vehicles/car1/odom, "
        "vehicles/car1/state, vehicles/car2/odom"
    ) in result.output
    assert "has no field" not in result.output


def test_a_field_of_only_some_messages_gives_no_warning(tmp_path: Path) -> None:
    rule = RULE.replace("msg.pose.X", "msg.door").replace(
        "stream: odom, value: msg.door", "stream: state, value: msg.door"
    )
    result = checked(tmp_path, DETECTOR.replace("/status", "/state"), rule)
    assert "has no field" not in result.output
    assert "no message of the recording" not in result.output
