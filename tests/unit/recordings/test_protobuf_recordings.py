"""MCAP files with Protobuf messages, as Foxglove's tools record them: read by the definitions that the files bring."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cbor2
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import Writer as PlainWriter
from mcap_protobuf.writer import Writer

from detector.replay.message import RecordingError
from detector.replay.routing import MessageRouter
from detector.testing import run
from tests.driving import a_detector, a_rule, a_stream, at
from tests.recorded import arrivals_of, messages_in
from wayside.api.stream import Encoding, Stream

F = descriptor_pb2.FieldDescriptorProto


def field(name: str, number: int, kind: int, label: int = F.LABEL_OPTIONAL, of: str = "", **more: Any) -> F:
    return F(name=name, number=number, type=kind, label=label, type_name=of or None, **more)


def track_type() -> Any:
    """lab.Track, with a message of its own, another file's, an enum, lists, a map, bytes and an optional field."""
    file = descriptor_pb2.FileDescriptorProto(
        name="lab/track.proto", package="lab", syntax="proto3", dependency=["google/protobuf/timestamp.proto"]
    )
    kind = file.enum_type.add(name="Kind")
    kind.value.add(name="CAR", number=0)
    kind.value.add(name="BIKE", number=1)
    track = file.message_type.add(name="Track")
    point = track.nested_type.add(name="Point")
    point.field.extend([field("x", 1, F.TYPE_DOUBLE), field("y", 2, F.TYPE_DOUBLE)])
    names = track.nested_type.add(name="NamesEntry", options=descriptor_pb2.MessageOptions(map_entry=True))
    names.field.extend([field("key", 1, F.TYPE_STRING), field("value", 2, F.TYPE_MESSAGE, of=".lab.Track.Point")])
    track.oneof_decl.add(name="_score")
    track.field.extend(
        [
            field("stamp", 1, F.TYPE_MESSAGE, of=".google.protobuf.Timestamp"),
            field("speed", 2, F.TYPE_DOUBLE),
            field("id", 3, F.TYPE_UINT64),
            field("kind", 4, F.TYPE_ENUM, of=".lab.Kind"),
            field("path", 5, F.TYPE_MESSAGE, F.LABEL_REPEATED, of=".lab.Track.Point"),
            field("names", 6, F.TYPE_MESSAGE, F.LABEL_REPEATED, of=".lab.Track.NamesEntry"),
            field("raw", 7, F.TYPE_BYTES),
            field("score", 8, F.TYPE_DOUBLE, oneof_index=0, proto3_optional=True),
            field("kinds", 9, F.TYPE_ENUM, F.LABEL_REPEATED, of=".lab.Kind"),
        ]
    )
    pool = descriptor_pool.DescriptorPool()
    stamps = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamps)
    pool.Add(stamps)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("lab.Track"))


def track(speed: float, seconds: float = 0.0) -> Any:
    message = track_type()(speed=speed, id=2**63 + 1, kind=1, raw=b"\x00\xff", kinds=[0, 1])
    message.stamp.seconds, message.stamp.nanos = divmod(at(seconds), 10**9)
    message.path.add(x=1.5, y=-2.0)
    message.names["nose"].x = 3.0
    return message


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file, Writer(file) as writer:
        for number in range(40):
            time = at(number / 10)
            message = track(20.0 if 10 <= number < 25 else 1.0, number / 10)
            writer.write_message("/vehicles/car/track", message, log_time=time, publish_time=time)
    return path


def first(recording: Path, encoding: Encoding) -> bytes:
    stream = Stream(name="track", key="vehicles/${client:*}/track", encoding=encoding)
    return next(arrivals_of(MessageRouter([stream]), messages_in([recording]))).payload


def test_protobuf_messages_are_plain_values_in_json_and_cbor(recording: Path) -> None:
    seconds, nanoseconds = divmod(at(0), 10**9)
    values = {
        "stamp": {"seconds": seconds, "nanos": nanoseconds},
        "speed": 1.0,
        "id": 2**63 + 1,
        "kind": "BIKE",
        "path": [{"x": 1.5, "y": -2.0}],
        "names": {"nose": {"x": 3.0, "y": 0.0}},
        "raw": b"\x00\xff",
        "kinds": ["CAR", "BIKE"],
    }
    assert cbor2.loads(first(recording, Encoding.CBOR)) == values
    assert json.loads(first(recording, Encoding.JSON)) == {**values, "raw": "AP8="}
    assert first(recording, Encoding.RAW) == track(1.0).SerializeToString()


@pytest.mark.parametrize(("encoding", "clock"), [("json", "Wall"), ("cbor", "Data")])
def test_a_recording_with_protobuf_replays(recording: Path, tmp_path: Path, encoding: str, clock: str) -> None:
    stream = a_stream("track", encoding=encoding, stamp="msg.stamp.seconds + msg.stamp.nanos / 1e9")
    signals = [
        {"name": "v", "stream": "track", "value": "msg.speed"},
        {"name": "kind", "stream": "track", "value": "msg.kind"},
    ]
    rule = a_rule("fast", signals=signals, when='v > 10 && kind == "BIKE"', evaluation={"every": "100ms"})
    (tmp_path / "detector.yaml").write_text(json.dumps(a_detector(stream, clock=clock).to_json()))
    (tmp_path / "rules.yaml").write_text(json.dumps(rule.to_json()))
    events = run(tmp_path / "rules.yaml", tmp_path / "detector.yaml", recording)
    assert [(event.started, event.episode.start_time - at(0)) for event in events] == [(True, 10**9), (False, 10**9)]


def test_each_item_of_a_list_of_protobuf_is_a_client(recording: Path, tmp_path: Path) -> None:
    stream = {"name": "track", "key": "${vehicle:*}/${name:*}/track", "encoding": "cbor"}
    items = {"items": "msg.path", "client": "${key.name}-${item.x * 2}"}
    rule = a_rule(signals=[{"name": "y", "stream": "track", "value": "item.y * msg.speed"}], when="y < -30")
    (tmp_path / "detector.yaml").write_text(json.dumps(a_detector({**stream, **items}).to_json()))
    (tmp_path / "rules.yaml").write_text(json.dumps(rule.to_json()))
    events = run(tmp_path / "rules.yaml", tmp_path / "detector.yaml", recording)
    assert [(event.episode.subject, event.started) for event in events] == [("car-3", True), ("car-3", False)]


def test_a_truncated_protobuf_recording_is_read_up_to_the_cut(recording: Path) -> None:
    whole = list(messages_in([recording]))
    recording.write_bytes(recording.read_bytes()[:-40])
    read = list(messages_in([recording]))
    assert [message.payload for message in read] == [message.payload for message in whole]
    assert read[0].decode is not None
    assert read[0].decode(read[0].payload)["kind"] == "BIKE"  # type: ignore[index]


def test_an_unsupported_stream_encoding_is_reported_with_the_supported_ones(recording: Path) -> None:
    stream = Stream(name="t", key="vehicles/${client:*}/track", encoding=Encoding.CDR, type="std_msgs/msg/Header")
    with pytest.raises(
        RecordingError, match=r"track is recorded as protobuf.*streams\[t\].encoding is cdr: write json"
    ):
        next(arrivals_of(MessageRouter([stream]), messages_in([recording])))


def test_an_invalid_protobuf_payload_is_counted_by_its_stream(recording: Path) -> None:
    (message, *_) = messages_in([recording])
    assert message.decode is not None
    with pytest.raises(ValueError, match=r"no lab\.Track"):
        message.decode(b"\xff")
    stream = Stream(name="track", key="vehicles/${client:*}/track", encoding=Encoding.JSON)
    (arrival,) = arrivals_of(MessageRouter([stream]), [message._replace(payload=b"\xff")])
    assert arrival.payload == b"\xff"


def test_a_file_without_message_definitions_is_an_error(tmp_path: Path) -> None:
    for schema, logged in ((None, "with no schema"), (b"\x00nonsense", "the definition of lab.Track")):
        path = tmp_path / "drive.mcap"
        with path.open("wb") as file:
            writer = PlainWriter(file)
            writer.start()
            number = 0 if schema is None else writer.register_schema("lab.Track", "protobuf", schema)
            channel = writer.register_channel("/vehicles/car/track", "protobuf", number)
            writer.add_message(channel, 1, b"", 1)
            writer.finish()  # type: ignore[no-untyped-call]
        with pytest.raises(RecordingError, match=logged):
            list(messages_in([path]))


def test_without_the_extra_the_error_reports_how_to_install_it(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap_protobuf.decoder", None)
    with pytest.raises(RecordingError, match=r"pip install 'wayside\[protobuf\]'"):
        list(messages_in([recording]))
