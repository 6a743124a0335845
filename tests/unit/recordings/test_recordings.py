"""Recordings of every kind read as the same messages, in order of time; errors are reported with their place."""

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from detector.engine.samples.sample import Arrival
from detector.replay.gathering import recordings_of
from detector.replay.intake_writer import IntakeWriter
from detector.replay.message import Message, RecordingError, Truncation
from detector.replay.routing import MessageRouter
from detector.streams.codecs.ros import standard
from tests.recorded import arrivals_of, messages_in
from tests.ros_messages import cdr, odometry, pose_stamped
from wayside.api.stream import Encoding, Stream

POSE_TYPE = "geometry_msgs/msg/PoseStamped"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSES = [cdr(pose_stamped(x=float(n))) for n in range(10)]
MESSAGES = [Message(100 * n, "car1/pose", raw, "cdr", POSE_TYPE) for n, raw in enumerate(POSES)] + [
    Message(2000, "odom", cdr(odometry()), "cdr", ODOMETRY_TYPE)
]


def write_mcap(path: Path, messages: list[Message], **options: Any) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        channels: dict[tuple[str, str | None], int] = {}
        for message in messages:
            place = (message.key, message.type)
            if place not in channels:
                schema = 0
                if message.type is not None:
                    schema = writer.register_schema(
                        message.type, "ros2msg", standard().definition(message.type).encode()
                    )
                channels[place] = writer.register_channel(f"/{message.key}", message.encoding, schema)
            writer.add_message(channels[place], message.time, message.payload, message.time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def write_bag(path: Path, messages: list[Message], storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with BagWriter(path, version=9, storage_plugin=storage) as writer:
        connections = {
            message.key: writer.add_connection(f"/{message.key}", message.type or "", typestore=standard().store)
            for message in {message.key: message for message in messages}.values()
        }
        for message in messages:
            writer.write(connections[message.key], message.time, message.payload)
    return path


def write_lines(path: Path, *lines: object) -> Path:
    path.write_text("".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines))
    return path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4, "chunk_size": 500},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
    ],
    ids=["zstd", "lz4", "uncompressed", "unchunked"],
)
def test_mcap_files_are_read(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write_mcap(tmp_path / "drive.mcap", MESSAGES, **options)
    assert list(messages_in([path])) == MESSAGES


def test_mcap_files_are_read_in_the_order_of_their_times(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "drive.mcap", MESSAGES[::-1], chunk_size=500)
    assert list(messages_in([path])) == MESSAGES


@pytest.mark.parametrize("storage", StoragePlugin)
def test_rosbag2_folders_are_read(tmp_path: Path, storage: StoragePlugin) -> None:
    path = write_bag(tmp_path / "bag", MESSAGES, storage)
    assert list(messages_in([path])) == MESSAGES
    (file,) = [entry for entry in path.iterdir() if entry.name != "metadata.yaml"]
    assert list(messages_in([file])) == MESSAGES


def test_json_lines_are_read_with_unchanged_values(tmp_path: Path) -> None:
    path = write_lines(
        tmp_path / "drive.jsonl",
        '{"t": 5, "key": "vehicles/car7/pose", "value": {"x": 1.50}}',
        "",
        '{"key": "/b", "value": [1], "t": 5}',
    )
    assert list(messages_in([path])) == [
        Message(5, "vehicles/car7/pose", b'{"x": 1.50}', "json", None),
        Message(5, "b", b"[1]", "json", None),
    ]


def test_an_intake_file_is_read_like_any_mcap_file(tmp_path: Path) -> None:
    stream = Stream(name="pose", key="${client:*}/pose", encoding=Encoding.CDR, type=POSE_TYPE)
    writer = IntakeWriter(tmp_path / "intake.mcap", [stream])
    writer.control(1, {"kind": "start"})
    writer.arrivals([Arrival(message.time, "pose", message.key, message.payload) for message in MESSAGES[:3]])
    writer.close()
    assert list(messages_in([tmp_path / "intake.mcap"], MessageRouter([stream]).wanted)) == MESSAGES[:3]


def test_several_recordings_are_merged_by_time(tmp_path: Path) -> None:
    paths = [
        write_mcap(tmp_path / "a.mcap", MESSAGES[::2]),
        write_bag(tmp_path / "bag", MESSAGES[1::2]),
        write_lines(tmp_path / "c.jsonl", {"t": 200, "key": "c", "value": 1}),
    ]
    merged = list(messages_in(paths))
    assert [message for message in merged if message.encoding == "cdr"] == MESSAGES
    assert [message.key for message in merged if message.time == 200] == ["car1/pose", "c"]


def test_only_wanted_keys_are_read(tmp_path: Path) -> None:
    paths = [
        write_mcap(tmp_path / "a.mcap", MESSAGES),
        write_bag(tmp_path / "bag", MESSAGES),
        write_lines(tmp_path / "c.jsonl", {"t": 1, "key": "odom", "value": 1}, {"t": 2, "key": "x", "value": 1}),
    ]
    assert [message.key for message in messages_in(paths, lambda key: key == "odom")] == ["odom"] * 3
    assert list(messages_in(paths, lambda key: False)) == []


GOOD = '{"t": 5, "key": "a", "value": {}}'


@pytest.mark.parametrize(
    ("lines", "where", "words"),
    [
        ([GOOD, "{"], 2, "truncated"),
        ([GOOD, "nonsense"], 2, "malformed"),
        ([GOOD, '{"t": 6, "key": "a"}'], 2, "value"),
        ([GOOD, '{"t": "6", "key": "a", "value": 1}'], 2, "int"),
        ([GOOD, '{"t": 6, "key": "a", "value": NaN}'], 2, "malformed"),
        ([GOOD, '{"t": 6, "key": "a", "value": 1, "stamp": 2}'], 2, "stamp"),
        ([GOOD, '{"t": 6, "key": "", "value": 1}'], 2, "key is empty"),
        ([GOOD, "", '{"t": 4, "key": "a", "value": 1}'], 3, "t decreases from 5 to 4"),
        (['{"t": -1, "key": "a", "value": 1}'], 1, "negative"),
    ],
)
def test_a_broken_line_is_reported_with_file_and_line(tmp_path: Path, lines: list[str], where: int, words: str) -> None:
    path = write_lines(tmp_path / "drive.jsonl", *lines)
    with pytest.raises(RecordingError) as caught:
        list(messages_in([path]))
    assert str(caught.value).startswith(f"{path}:{where}: ")
    assert words in str(caught.value)


def test_files_that_are_not_recordings_are_rejected_at_once(tmp_path: Path) -> None:
    def refused(path: Path) -> str:
        with pytest.raises(RecordingError) as caught:
            messages_in([path])
        assert str(path) in str(caught.value)
        return str(caught.value)

    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.txt").write_text("hello")
    (tmp_path / "data.sqlite").write_bytes(b"SQLite format 3\0rest")
    assert "no such file" in refused(tmp_path / "missing.mcap")
    assert "metadata.yaml" in refused(tmp_path)
    assert "empty" in refused(tmp_path / "empty.mcap")
    assert "text.txt is not a recording that Wayside can read; it reads rosbag2 folders" in refused(
        tmp_path / "text.txt"
    )
    assert ".db3" in refused(tmp_path / "data.sqlite")


def damage(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def write_sqlite(path: Path, messages: list[Message]) -> Path:
    return write_bag(path, messages, StoragePlugin.SQLITE3)


SHARES = [0.01, 0.1, 0.3, 0.5, 0.8, 0.99]


@pytest.mark.parametrize("share", SHARES)
def test_a_truncated_sqlite_bag_is_an_error_that_names_it(tmp_path: Path, share: float) -> None:
    path = write_sqlite(tmp_path / "drive", MESSAGES * 20)
    for file in path.glob("*.db3"):
        damage(file, share)
    with pytest.raises(RecordingError, match=rf"{tmp_path}.*sqlite3 {path}/drive.db3 \.recover"):
        list(messages_in([path]))


def read_up_to_a_cut(path: Path, written: list[Message]) -> int:
    """How many messages are read: those written first, in the order of their times."""
    reported: list[Truncation] = []
    read = list(messages_in([path], on_cut=reported.append))
    assert read == sorted(written[: len(read)], key=lambda message: message.time)
    assert reported or len(read) == len(written)  # where only the index is missing, nothing is
    for cut in reported:
        assert cut.messages == len(read)
        assert f"it contains {len(read)} messages up to there" in str(cut)
    return len(read)


@pytest.mark.parametrize(
    "options",
    [
        {"chunk_size": 1000},
        {"chunk_size": 1000, "compression": CompressionType.LZ4},
        {"chunk_size": 1000, "compression": CompressionType.NONE},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
    ],
    ids=["zstd", "lz4", "uncompressed", "one chunk", "unchunked"],
)
def test_a_truncated_mcap_file_is_read_up_to_the_cut(tmp_path: Path, options: dict[str, Any]) -> None:
    written = MESSAGES * 20
    whole = write_mcap(tmp_path / "whole.mcap", written, **options).read_bytes()
    counts = []
    for share in SHARES:
        path = tmp_path / "cut.mcap"
        path.write_bytes(whole[: int(len(whole) * share)])
        counts.append(read_up_to_a_cut(path, written))
    assert counts == sorted(counts)
    assert counts[0] == 0 < counts[2] < counts[3] <= counts[-1]


def test_an_mcap_file_with_unwritten_last_bytes_is_read_up_to_them(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "drive.mcap", MESSAGES * 20, chunk_size=1000)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] + bytes(len(whole) // 2))
    assert read_up_to_a_cut(path, MESSAGES * 20) > 50


def test_a_closed_mcap_file_without_an_index_is_complete(tmp_path: Path) -> None:
    none = IndexType.NONE
    path = write_mcap(tmp_path / "drive.mcap", MESSAGES, chunk_size=500, index_types=none, use_statistics=False)
    reported: list[Truncation] = []
    assert list(messages_in([path], on_cut=reported.append)) == MESSAGES
    assert reported == []


def test_an_mcap_file_with_damaged_content_is_an_error_with_the_remedy(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "drive.mcap", MESSAGES * 20, chunk_size=1000)
    whole = bytearray(path.read_bytes())
    for place in range(len(whole) // 3, len(whole) // 3 + 400):
        whole[place] ^= 0xFF
    path.write_bytes(whole)
    with pytest.raises(RecordingError, match=r"drive\.mcap: the MCAP file is damaged .*mcap recover"):
        list(messages_in([path]))


@pytest.mark.parametrize("share", SHARES[1:-1])
def test_a_rosbag2_of_a_killed_recorder_is_read_up_to_the_cut(tmp_path: Path, share: float) -> None:
    path = write_bag(tmp_path / "drive", MESSAGES * 20)
    (file,) = path.glob("*.mcap")
    damage(file, share)
    reported: list[Truncation] = []
    read = list(messages_in([path], on_cut=reported.append))
    assert [(cut.path, cut.messages) for cut in reported] == [(file, len(read))]
    (path / "metadata.yaml").unlink()  # it is written when the recorder ends
    assert recordings_of([path]) == [(file,)]
    assert list(messages_in([file])) == read


def test_an_incomplete_last_line_counts_as_truncation(tmp_path: Path) -> None:
    path = write_lines(tmp_path / "drive.jsonl", *({"t": n, "key": "a", "value": n} for n in range(10)))
    whole = path.read_bytes()
    for size in range(len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        reported: list[Truncation] = []
        read = list(messages_in([path], on_cut=reported.append))
        lines, rest = whole[:size].count(b"\n"), whole[:size].rpartition(b"\n")[2]
        complete = rest.endswith(b"}") or not rest
        assert [message.time for message in read] == list(range(lines + (bool(rest) and complete)))
        assert [cut.messages for cut in reported] == ([] if complete else [len(read)])


def stream(name: str, key: str, type_name: str | None = POSE_TYPE) -> Stream:
    encoding = Encoding.JSON if type_name is None else Encoding.CDR
    return Stream(name=name, key=key, encoding=encoding, type=type_name, client=None if "${" in key else "ego")


def test_messages_are_delivered_to_every_stream_of_their_key_in_order_of_time() -> None:
    router = MessageRouter([stream("pose", "${client:*}/pose"), stream("all", "**/${client:*}/pose")])
    assert router.wanted("car1/pose")
    assert not router.wanted("odom")
    assert router.unrouted == ["odom"]
    arrivals = list(arrivals_of(router, [MESSAGES[1], MESSAGES[1], MESSAGES[-1], MESSAGES[2]]))
    assert [(arrival.received, arrival.stream) for arrival in arrivals] == [
        (100, "pose"),
        (100, "all"),
        (100, "pose"),
        (100, "all"),
        (200, "pose"),
        (200, "all"),
    ]
    assert arrivals[0].payload == POSES[1]


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        (stream("odometry", "odom", POSE_TYPE), ["odom", ODOMETRY_TYPE, POSE_TYPE, "streams[odometry].type"]),
        (stream("odometry", "odom", None), ["odom", "cdr", "json", "streams[odometry].encoding"]),
    ],
)
def test_a_message_of_another_type_than_its_streams_is_an_error_that_names_both(
    declared: Stream, words: list[str]
) -> None:
    with pytest.raises(RecordingError) as caught:
        list(arrivals_of(MessageRouter([declared]), MESSAGES))
    for word in words:
        assert word in str(caught.value)
