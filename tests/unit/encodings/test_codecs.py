"""Codecs yield plain values with doubles, and whatever the bytes are, nothing but DecodeError."""

from typing import Any

import cbor2
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.samples.sample import Arrival, DecodeError
from detector.streams.codecs import CborDecoder, CdrDecoder, JsonDecoder, RawDecoder, UnknownTypeError, codec_for
from detector.streams.codecs.json_ import MAX_DEPTH
from tests.driving import Drive, a_detector, a_rule, at
from tests.ros_messages import cdr, make, odometry, point_cloud, pose_stamped
from tests.unit.encodings import hostile
from tests.unit.encodings.hostile import assert_plain
from wayside.api.stream import Encoding, Stream
from wayside.expressions.numbers import MAX_EXACT

MESSAGES = [pose_stamped(), odometry(), point_cloud()]
SECOND = 1_000_000_000


def decoder(message: Any) -> CdrDecoder:
    return CdrDecoder(message.__msgtype__)


def test_a_ros_message_becomes_a_map_of_doubles_and_text() -> None:
    assert decoder(MESSAGES[0]).decode(cdr(MESSAGES[0])) == {
        "header": {"stamp": {"sec": 5.0, "nanosec": 7.0}, "frame_id": "map"},
        "pose": {
            "position": {"x": 1.0, "y": 2.0, "z": 0.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    }


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.__msgtype__)
def test_both_byte_orders_read_the_same(message: Any) -> None:
    little = decoder(message).decode(cdr(message))
    assert_plain(little)
    assert decoder(message).decode(cdr(message, little_endian=False)) == little


def test_arrays_of_numbers_become_lists() -> None:
    value = decoder(MESSAGES[1]).decode(cdr(MESSAGES[1]))
    assert value["pose"]["covariance"] == [float(i) for i in range(36)]
    assert value["child_frame_id"] == "base"


def test_octets_stay_bytes_and_nested_messages_become_lists() -> None:
    value = decoder(MESSAGES[2]).decode(cdr(MESSAGES[2]))
    assert value["data"] == bytes(i % 256 for i in range(120))
    assert [field["name"] for field in value["fields"]] == ["x", "y", "z"]
    assert value["width"] == 10.0
    assert value["is_dense"] is True


def test_a_message_larger_than_the_copying_limit_reads_the_same() -> None:
    cloud = point_cloud(100_000)
    assert len(decoder(cloud).decode(cdr(cloud))["data"]) == 1_200_000


@pytest.mark.parametrize("value", [0, MAX_EXACT, MAX_EXACT + 1, 2**63 - 1, -(2**63)])
def test_integers_beyond_doubles_stay_integers(value: int) -> None:
    expected = int if abs(value) > MAX_EXACT else float
    scalar = CdrDecoder("std_msgs/msg/Int64").decode(cdr(make("std_msgs/Int64", data=value)))["data"]
    layout = make("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
    array = make("std_msgs/Int64MultiArray", layout=layout, data=np.array([value, 1], np.int64))
    listed = CdrDecoder("std_msgs/msg/Int64MultiArray").decode(cdr(array))["data"]
    json = JsonDecoder().decode(str(value).encode())
    assert [scalar, listed[0], json] == [value] * 3
    assert {type(scalar), type(listed[0]), type(json)} == {expected}


def test_types_without_a_field_or_with_one_are_read() -> None:
    assert CdrDecoder("std_msgs/msg/Empty").decode(b"\x00\x01\x00\x00\x00") == {}
    assert CdrDecoder("std_msgs/msg/String").decode(cdr(make("std_msgs/String", data="ü"))) == {"data": "ü"}
    assert CdrDecoder("std_msgs/msg/Byte").decode(b"\x00\x01\x00\x00\xff") == {"data": 255.0}


def test_nan_and_infinity_pass_through_cdr() -> None:
    point = decoder(MESSAGES[0]).decode(cdr(pose_stamped(float("nan"), float("inf"))))["pose"]["position"]
    assert point["x"] != point["x"]
    assert point["y"] == float("inf")


@pytest.mark.parametrize("little_endian", [True, False])
def test_the_stamp_is_read_without_decoding(little_endian: bool) -> None:
    raw = cdr(pose_stamped(seconds=2**31 - 1, nanoseconds=SECOND - 1), little_endian=little_endian)
    assert decoder(MESSAGES[0]).stamp(raw) == 2**31 * SECOND - 1
    assert decoder(MESSAGES[0]).stamp(raw[:12]) == 2**31 * SECOND - 1


def test_types_without_a_header_have_no_stamp() -> None:
    assert CdrDecoder("geometry_msgs/msg/Point").stamp(b"anything") is None
    assert JsonDecoder().stamp(b"{}") is None


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"\x00\x01\x00\x00",
        cdr(MESSAGES[0])[:11],
        b"\x00\x03" + cdr(MESSAGES[0])[2:],
        cdr(pose_stamped(seconds=-1)),
        cdr(pose_stamped(nanoseconds=SECOND)),
    ],
)
def test_an_invalid_stamp_is_rejected(raw: bytes) -> None:
    with pytest.raises(DecodeError, match=r"geometry_msgs/msg/PoseStamped"):
        decoder(MESSAGES[0]).stamp(raw)


def test_a_sequence_longer_than_the_message_is_refused_before_it_is_allocated() -> None:
    raw = bytearray(cdr(point_cloud(0)))
    raw[-8:-4] = b"\xff\xff\xff\xff"
    with pytest.raises(DecodeError, match="length"):
        decoder(MESSAGES[2]).decode(bytes(raw))


@settings(max_examples=500)
@given(st.sampled_from(MESSAGES), st.data())
def test_truncated_cdr_is_refused(message: Any, data: st.DataObject) -> None:
    raw = cdr(message)
    with pytest.raises(DecodeError):
        decoder(message).decode(raw[: data.draw(st.integers(0, len(raw) - 1))])


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)


@given(json_values)
def test_json_reads_back_with_doubles(value: Any) -> None:
    decoded = JsonDecoder().decode(msgspec.json.encode(value))
    assert decoded == value
    assert_plain(decoded)


@pytest.mark.parametrize("payload", [b"", b"NaN", b"[Infinity]", b"{'a': 1}", b"[1,]", b"\xff", b"1 2"])
def test_nonstandard_json_is_rejected(payload: bytes) -> None:
    with pytest.raises(DecodeError, match="not JSON"):
        JsonDecoder().decode(payload)


def test_nesting_is_bounded() -> None:
    assert JsonDecoder().decode(b"[" * MAX_DEPTH + b"]" * MAX_DEPTH)
    with pytest.raises(DecodeError, match=f"more than {MAX_DEPTH} levels deep"):
        JsonDecoder().decode(b"[" * (MAX_DEPTH + 1) + b"]" * (MAX_DEPTH + 1))


@pytest.mark.parametrize("encoding", [Encoding.JSON, Encoding.CDR, Encoding.CBOR, Encoding.RAW])
def test_the_codec_follows_the_stream(encoding: Encoding) -> None:
    kind = {"type": "nav_msgs/msg/Odometry"} if encoding is Encoding.CDR else {}
    codecs = {"json": JsonDecoder, "cdr": CdrDecoder, "cbor": CborDecoder, "raw": RawDecoder}
    assert type(codec_for(Stream(name="s", key="${client:*}", encoding=encoding, **kind))) is codecs[encoding]


def test_an_unknown_type_is_reported_with_its_stream_and_similar_types() -> None:
    stream = Stream(name="pose", key="${client:*}", encoding=Encoding.CDR, type="geometry_msgs/msg/PoseStampd")
    with pytest.raises(
        UnknownTypeError, match=r"streams\[pose\]\.type.*PoseStampd.*did you mean geometry_msgs/msg/Pose"
    ):
        codec_for(stream)


def test_ten_thousand_hostile_payloads_of_cdr_give_a_message_or_a_decode_error() -> None:
    for number, message in enumerate(MESSAGES):
        valid = [cdr(message), cdr(message, little_endian=False)]
        refused = hostile.survive(decoder(message), hostile.payloads(valid, 3500, seed=number))
        assert 1000 < refused < 3450


def test_ten_thousand_hostile_payloads_of_json_give_a_value_or_a_decode_error() -> None:
    valid = [b'{"header": {"stamp": 1.5, "frame": "map"}, "objects": [{"x": 1.0, "id": 7}, null, true]}', b"[[[1e9]]]"]
    refused = hostile.survive(JsonDecoder(), hostile.payloads(valid, 10_000, seed=1))
    assert 3000 < refused < 9900
    extreme = [b"[" * 1_000_000, b'{"a":' * 100_000, b"1" * 5_000, b"1e999", b'"\\ud800"']
    hostile.survive(JsonDecoder(), iter(extreme))


POSES = {"encoding": "cdr", "type": "geometry_msgs/msg/PoseStamped"}
VALID = {
    "cdr": cdr(MESSAGES[0]),
    "json": b'{"x": [1, 2, {"y": "text"}], "z": null}',
    "cbor": cbor2.dumps({"x": [1, 2, {"y": "text"}], "z": None}),
}


@pytest.mark.parametrize("encoding", VALID)
def test_a_detector_counts_unreadable_payloads_and_continues(encoding: str) -> None:
    stream = {"name": "s", "key": "${client:*}", "encoding": encoding, **(POSES if encoding == "cdr" else {})}
    looked = {"name": "n", "stream": "s", "where": "has(msg.x)", "over": "10s", "aggregate": "Count"}
    drive = Drive(a_detector(stream), a_rule("r", signals=[looked], when="n >= 0"))
    hostile_ones = [*hostile.payloads([VALID[encoding]], 500, seed=1)]
    refused = hostile.survive(codec_for(drive.detector.spec.streams[0]), iter(hostile_ones))
    samples = [Arrival(at(number / 1000), "s", "car", raw) for number, raw in enumerate(hostile_ones)]
    assert drive.take(*samples, until=1) == ["r car started 1"]
    assert drive.engine.counters.undecodable["s"] == refused > 100
    assert drive.engine.counters.last_undecodable["s"].startswith("car: not ")
