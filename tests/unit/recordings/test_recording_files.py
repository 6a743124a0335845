"""The contents of a recording, read by the libraries mcap and rosbags, and its description."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import yaml
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability
from rosbags.rosbag2 import Reader

from detector.actions.episode import Completion, OutcomeState
from tests.driving import a_stream, at
from tests.recording_bench import (
    STREAMS,
    Bench,
    a_sample,
    an_episode,
    as_recorded,
    mcap_files,
    metadata_of,
    pose,
    read_with_mcap,
    read_with_rosbags,
    speed,
    tf_static,
)

LARGE = os.urandom(1_000_000)


@pytest.mark.parametrize("compression", ["None", "Lz4", "Zstd"])
def test_both_readers_find_every_sample_once_and_bit_by_bit(tmp_path: Path, compression: str) -> None:
    bench = Bench(tmp_path, compression=compression)
    ros = [pose(1 + k / 100, k, client) for k in range(300) for client in ("car1", "car2")]
    others = [speed(1 + k / 10, k) for k in range(30)] + [a_sample(1 + k / 10, "points", LARGE) for k in range(5)]
    others.append(a_sample(2, "objects", b"\xa1av\x01"))
    others.append(a_sample(2, "points", b""))
    given = sorted([*ros, *others], key=lambda each: each.time)
    folder = bench.record(an_episode(clients=("car1", "car2")), given)
    (file,) = mcap_files(folder)
    assert sorted(read_with_mcap(file)) == sorted(map(as_recorded, given))
    assert sorted(read_with_rosbags(folder)) == sorted(map(as_recorded, ros))
    assert sorted(read_with_rosbags(file)) == sorted(map(as_recorded, given))
    with file.open("rb") as stream:  # one record after the other, as a reader without an index goes
        assert sum(
            1 for each in StreamReader(stream, validate_crcs=True).records if type(each).__name__ == "Message"
        ) == len(given)
    outcome = bench.outcome(an_episode())
    assert (outcome.state, outcome.samples, outcome.missing) == (OutcomeState.DONE, len(given), 0)
    assert outcome.bytes == sum(each.stat().st_size for each in folder.iterdir())
    assert [tmp_path / each for each in outcome.files] == [file]


def test_a_late_sample_is_found_at_its_own_time(tmp_path: Path) -> None:
    given = [pose(1.1, 1), pose(1.3, 3), pose(1.2, 2)]
    (file,) = mcap_files(Bench(tmp_path).record(an_episode(), given))
    assert read_with_mcap(file) == sorted(map(as_recorded, given), key=lambda each: each.time)


def test_channels_have_the_client_and_the_encoding(tmp_path: Path) -> None:
    given = [tf_static(0.5), pose(1.1), pose(1.1, client="car2"), speed(1.2), a_sample(1.2, "objects", b"\x01")]
    (file,) = mcap_files(Bench(tmp_path, before="1s").record(an_episode(), given))
    with file.open("rb") as stream:
        reader = SeekingReader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert summary is not None
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert {
        topic: (c.message_encoding, c.metadata["stream"], c.metadata["client"]) for topic, c in channels.items()
    } == {
        "/vehicles/car1/tf-static": ("cdr", "tf-static", "car1"),
        "/vehicles/car1/pose": ("cdr", "pose", "car1"),
        "/vehicles/car2/pose": ("cdr", "pose", "car2"),
        "/vehicles/car1/speed": ("json", "speed", "car1"),
        "/vehicles/car1/objects": ("cbor", "objects", "car1"),
    }
    assert channels["/vehicles/car1/speed"].schema_id == 0
    schema = summary.schemas[channels["/vehicles/car1/pose"].schema_id]
    assert (schema.name, schema.encoding) == ("geometry_msgs/msg/PoseStamped", "ros2msg")
    assert b"MSG: geometry_msgs/Quaternion" in schema.data
    assert len(summary.schemas) == 2


def test_latched_topics_have_the_qos_for_late_joiners(tmp_path: Path) -> None:
    folder = Bench(tmp_path, before="1s").record(an_episode(), [tf_static(0.5), pose(1.1)])
    with Reader(folder) as reader:
        durability = {
            each.topic: each.ext.offered_qos_profiles[0].durability
            for each in reader.connections
            if isinstance(each.ext, ConnectionExtRosbag2)
        }
    assert durability == {
        "/vehicles/car1/tf-static": QosDurability.TRANSIENT_LOCAL,
        "/vehicles/car1/pose": QosDurability.VOLATILE,
    }


def test_the_publish_time_is_the_stamp_or_else_the_receive_time(tmp_path: Path) -> None:
    stamped = a_stream("speed", stamp="msg.v")
    bench = Bench(tmp_path, *(each for each in STREAMS if each["name"] != "speed"), stamped)
    unread = a_sample(1.4, "pose", b"short")
    samples = [pose(1.1), speed(1.2, 9.5), a_sample(1.3, "points", b"x"), unread]
    (file,) = mcap_files(bench.record(an_episode(), samples))
    with file.open("rb") as stream:
        times = [message.publish_time for *_, message in SeekingReader(stream).iter_messages()]
    assert times == [5_000_000_007, 9_500_000_000, at(1.3), at(1.4)]


def test_samples_latched_before_the_window_are_at_its_start(tmp_path: Path) -> None:
    long_ago, within = tf_static(-1000), tf_static(0.7, "camera")
    folder = Bench(tmp_path, before="500ms").record(an_episode(), [long_ago, within, pose(0.8)])
    assert [(each.topic[-9:], each.time) for each in read_with_mcap(mcap_files(folder)[0])] == [
        ("tf-static", 0.5),
        ("tf-static", 0.7),
        ("car1/pose", 0.8),
    ]


def test_every_file_of_a_split_recording_begins_with_the_latched_samples(tmp_path: Path) -> None:
    bench = Bench(tmp_path, split={"duration": "1s"})
    first, other, newer = tf_static(0.0), tf_static(0.0, "camera"), tf_static(2.5)
    poses = [pose(1 + k / 10, k) for k in range(35)]
    given = sorted([first, other, newer, *poses], key=lambda each: each.time)
    folder = bench.record(an_episode(), given)
    files = [read_with_mcap(file) for file in mcap_files(folder)]
    assert [sum(each.topic.endswith("pose") for each in file) for file in files] == [10, 10, 10, 5]
    latched = [[each.payload for each in file if each.topic.endswith("tf-static")] for file in files]
    assert latched == [
        [first.payload, other.payload],
        [first.payload, other.payload, newer.payload],
        [other.payload, newer.payload],
        [other.payload, newer.payload],
    ]
    assert [file[0].time for file in files] == [1.0, 2.0, 3.0, 4.0]
    assert sorted(read_with_rosbags(folder)) == sorted(each for file in files for each in file)
    assert bench.outcome(an_episode()).samples == len(given)


def test_files_are_split_near_the_size_limit(tmp_path: Path) -> None:
    bench = Bench(tmp_path, split={"bytes": "2500k"})
    given = [a_sample(1 + k / 10, "points", LARGE) for k in range(7)]
    files = mcap_files(bench.record(an_episode(), given))
    assert [len(read_with_mcap(file)) for file in files] == [2, 2, 2, 1]
    assert max(file.stat().st_size for file in files) < 2_500_000


def test_name_folder_and_metadata_describe_the_episode(tmp_path: Path) -> None:
    bench = Bench(tmp_path, rule="harsh-braking", metadata={"driver": "${x}"})
    episode = an_episode(
        rule="harsh-braking", clients=("car1", "car2"), element="north", rendered={"driver": "Ann", "runs": [1]}
    )
    folder = bench.record(episode, [pose(1.1)])
    assert folder == tmp_path / "harsh-braking" / "2026-01-01T00-00-01-000Z_harsh-braking_car1+car2_bag_episode1"
    (file,) = mcap_files(folder)
    metadata = metadata_of(file)
    assert metadata["wayside"] == {
        "format": "wayside recording 1",
        "holder": "h",
        "detector": "d",
        "rule": "harsh-braking",
        "generation": "0",
        "action": "bag",
        "episode": "episode1",
        "subject": "car1+car2",
        "subjects": '["car1", "car2"]',
        "element": "north",
        "onsetTime": "2026-01-01T00:00:01.000000000Z",
        "startTime": "2026-01-01T00:00:01.000000000Z",
        "classification": '{"typeOfAction": ["DataCollection"]}',
        "values": '{"speed": 3.0}',
        "file": "0",
    }
    assert metadata["metadata"] == {"driver": "Ann", "runs": "[1]"}
    assert metadata["wayside/end"] == {
        "rule": "harsh-braking",
        "episode": "episode1",
        "endTime": "2026-01-01T00:00:02.000000000Z",
        "reason": "Until",
        "samples": "1",
    }
    reported = json.loads((folder / "recording.json").read_text())
    assert (reported["subjects"], reported["reason"], reported["metadata"]) == (
        ["car1", "car2"],
        "Until",
        episode.rendered,
    )
    bag = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert bag["custom_data"]["endTime"] == "2026-01-01T00:00:02.000000000Z"
    assert bag["message_count"] == 1


def test_a_stream_whose_type_changes_gets_another_channel(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    episode = an_episode()
    bench.action.started(episode)
    bench.action.samples(episode, [speed(1.1)])
    bench.detector = Bench(tmp_path, a_stream("speed", encoding="cbor")).detector
    bench.action.samples(episode, [a_sample(1.2, "speed", b"\x01")])
    bench.action.completed(episode, Completion())
    (file,) = mcap_files(bench.folder(episode))
    with file.open("rb") as stream:
        found = [(c.message_encoding, m.data) for _, c, m in SeekingReader(stream).iter_messages()]
    assert found == [("json", b'{"v": 0.0}'), ("cbor", b"\x01")]


def test_a_message_of_two_streams_is_written_once_in_a_readable_encoding(tmp_path: Path) -> None:
    twin = {**a_stream("raw-speed", encoding="raw"), "key": "vehicles/${client:*}/speed"}
    bench = Bench(tmp_path, twin, a_stream("speed"))
    sample = speed(1.1)
    folder = bench.record(an_episode(), [sample._replace(stream="raw-speed"), sample])
    (file,) = mcap_files(folder)
    with file.open("rb") as stream:
        assert [c.metadata["stream"] for _, c, _ in SeekingReader(stream).iter_messages()] == ["speed"]
    assert bench.outcome(an_episode()).missing == 0


def test_an_episode_without_samples_has_an_empty_recording(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    folder = bench.record(an_episode(), [])
    assert read_with_rosbags(folder) == []
    assert bench.outcome(an_episode()).state is OutcomeState.DONE


def test_a_resumed_episode_continues_in_another_recording_marked_as_such(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    whole = bench.record(an_episode(), [pose(1.1)])
    resumed = an_episode(resumed=True)
    latched = tf_static(0.1)
    folder = bench.record(resumed, [latched, pose(7.5)])
    again = bench.record(resumed, [latched, pose(9.5)])
    assert [each.name.removeprefix(whole.name) for each in (folder, again)] == ["_continued", "_continued_2"]
    (file,) = mcap_files(folder)
    assert metadata_of(file)["wayside"]["continued"] == "true"
    assert [each.time for each in read_with_mcap(file)] == [7.5, 7.5]


def test_missing_samples_are_reported_in_name_metadata_and_outcome(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    folder = bench.record(an_episode(), [pose(1.1)], Completion(missing=4))
    assert folder.name.endswith("_cut")
    assert metadata_of(mcap_files(folder)[0])["cut"] == {"reason": "4 samples of the window are missing"}
    outcome = bench.outcome(an_episode())
    assert (outcome.state, outcome.missing, outcome.samples) == (OutcomeState.FAILED, 4, 1)


def test_a_window_that_ends_early_is_reported(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    folder = bench.record(an_episode(), [pose(1.1)], Completion(cut="the detector stops"))
    assert folder.name.endswith("_cut")
    assert json.loads((folder / "recording.json").read_text())["cut"] == "the detector stops"
    assert bench.outcome(an_episode()).message == "the detector stops"


def test_a_recording_in_progress_is_hidden(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    episode = an_episode()
    bench.action.started(episode)
    bench.action.samples(episode, [pose(1.1)])
    assert all(each.name.startswith(".") for each in (tmp_path / "r").iterdir())
    bench.action.close()
    assert [each.name.endswith("_cut") for each in (tmp_path / "r").iterdir()] == [True]
