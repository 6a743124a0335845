"""Fields of ROS 2 messages are read as the decoder of whole messages reads them, whatever the payloads are."""

import struct
from collections.abc import Sequence
from random import Random
from typing import Any

import pytest

from detector.engine.samples.sample import MISSING, DecodeError, FieldDecoder
from detector.streams.codecs import CdrDecoder, cdr_columns, cdr_fields
from detector.streams.codecs.cdr_columns import LEAST
from detector.streams.codecs.definitions import Definition
from detector.streams.codecs.ros import RosTypes, standard, types_with
from tests.ros_messages import cdr, make, odometry, point_cloud, pose_stamped
from tests.unit.encodings import hostile
from tests.unit.encodings.random_ros_messages import random_message, random_paths, serialized
from tests.unit.encodings.whole_messages import Path, assert_reads_as_decoded, plain

POSITION: list[Path] = [("pose", "position", "x"), ("pose", "position", "y")]
STANDARD = sorted(standard().store.fielddefs)
PARTS = 8

UNUSUAL = """
uint8 a
Inner[3] few
string[2] texts
Inner[40] many
Mixed[] mixed
int64[2] large
Nothing nothing
float64[] doubles
float64 behind_doubles
bool[] flags
float64[] more
float64 behind_more
uint8 c
Wide[3] three_wide
Wide[40] many_wide
Wide[] wide
uint32 behind_wide
Point[] points
float64 behind_points
Nothing[] nothings
Deep[] deep
uint16 last
================================================================================
MSG: test_msgs/Inner
uint8 a
float64 b
uint16 c
================================================================================
MSG: test_msgs/Mixed
uint32 a
float64 b
byte c
================================================================================
MSG: test_msgs/Wide
float64 a
uint8 b
================================================================================
MSG: test_msgs/Point
float64 a
================================================================================
MSG: test_msgs/Nothing
================================================================================
MSG: test_msgs/Deep
string name
Mixed[] mixed
Inner[2] inner
"""


def with_type(text: str, name: str = "test_msgs/msg/Own") -> RosTypes:
    return types_with((Definition(name, text.strip()),))


class FieldsOnly(CdrDecoder):
    """Fails where a reader of fields decodes a message whole."""

    def decode(self, payload: bytes) -> Any:
        raise AssertionError(payload)


def check(types: RosTypes, type_name: str, random: Random, rounds: int = 1) -> None:
    """Random messages, whole and tampered with, of both byte orders."""
    decoder = CdrDecoder(type_name, types)
    for _ in range(rounds):
        messages = [random_message(types, type_name, random) for _ in range(3)]
        little, big = ([serialized(types, message, order) for message in messages] for order in (True, False))
        first = little[0]
        odd = [first[: random.randrange(len(first))], first + b"\0" * random.randrange(1, 6), b"", b"\0\2" + first[2:]]
        tampered = list(hostile.payloads([*little, *big], 6, seed=random.randrange(10**6)))
        paths = random_paths(types, type_name, random)
        reader = FieldsOnly(type_name, types).field_reader(paths)
        assert reader is not None
        assert not reader(little).errors
        assert not reader(big).errors
        assert_reads_as_decoded(decoder, paths, [*little, *odd, *tampered, *big[:1]])
        assert_reads_as_decoded(decoder, paths, [*big, *little[:1], *odd[:1]])
        many = [*little, *odd, *tampered, *big[:1]] * 2
        random.shuffle(many)
        assert_reads_as_one_by_one(decoder, paths, many)
        assert_reads_as_one_by_one(decoder, paths, [*big, *big, *odd])


def assert_reads_as_one_by_one(decoder: CdrDecoder, paths: Sequence[Path], payloads: Sequence[bytes]) -> None:
    """All payloads of one layout are read together, and give what they give one by one."""
    reader = decoder.field_reader(paths)
    assert reader is not None
    assert len(payloads) < LEAST
    alone = reader(payloads)
    with pytest.MonkeyPatch.context() as patch:
        for module in (cdr_columns, cdr_fields):
            patch.setattr(module, "LEAST", 1)
        together = reader(payloads)
    columns = [repr(plain(column)) for column in together.columns]
    assert columns == [repr(plain(column)) for column in alone.columns], payloads
    assert {place: str(error) for place, error in together.errors.items()} == {
        place: str(error) for place, error in alone.errors.items()
    }
    assert list(together.odd) == list(alone.odd)


def test_values_are_plain_as_decoded_or_missing() -> None:
    reader = CdrDecoder("geometry_msgs/msg/PoseStamped").field_reader(
        [*POSITION, ("pose", "nowhere"), ("header", "stamp")]
    )
    assert reader is not None
    found = reader([cdr(pose_stamped(1.0, 2.0)), b"", cdr(pose_stamped(3.0, 4.0), little_endian=False)])
    stamp = {"sec": 5.0, "nanosec": 7.0}
    expected = [[1.0, MISSING, 3.0], [2.0, MISSING, 4.0], [MISSING] * 3, [stamp, MISSING, stamp]]
    assert [list(column) for column in found.columns] == expected
    assert [type(error) for error in found.errors.values()] == [DecodeError]
    assert list(found.errors) == [1]
    assert not found.odd


def test_a_path_through_a_scalar_makes_every_message_odd() -> None:
    reader = CdrDecoder("nav_msgs/msg/Odometry").field_reader([("child_frame_id", "x"), ("pose", "covariance", 36)])
    assert reader is not None
    found = reader([cdr(odometry())] * 2)
    assert list(found.odd) == [0, 1]
    assert [list(column) for column in found.columns] == [[MISSING] * 2] * 2


def test_without_paths_only_unreadable_payloads_are_reported() -> None:
    assert assert_reads_as_decoded(CdrDecoder("geometry_msgs/msg/PoseStamped"), [], [cdr(pose_stamped()), b""]) == 1


def test_cdr_has_a_reader_of_fields() -> None:
    assert isinstance(CdrDecoder("std_msgs/msg/String"), FieldDecoder)


@pytest.mark.parametrize("part", range(PARTS))
def test_random_fields_of_every_standard_type_read_as_decoded(part: int) -> None:
    for number, type_name in enumerate(STANDARD[part::PARTS]):
        check(standard(), type_name, Random(PARTS * number + part))


@pytest.mark.parametrize("message", [pose_stamped(), odometry(), point_cloud(2)], ids=lambda each: each.__msgtype__)
@pytest.mark.parametrize("little_endian", [True, False])
def test_a_message_that_ends_anywhere_too_early_is_refused(message: Any, little_endian: bool) -> None:
    raw = cdr(message, little_endian=little_endian)
    decoder = CdrDecoder(message.__msgtype__)
    ends = [raw[:length] for length in range(len(raw))]
    for paths in ([("header", "frame_id")], [("header", "stamp", "sec"), ("header",)]):
        assert assert_reads_as_decoded(decoder, paths, [*ends, raw, raw + b"\0" * 3, raw + b"\0" * 4]) == len(raw) + 1


@pytest.mark.parametrize("seed", range(4))
def test_alignment_and_nesting_of_own_types_read_as_decoded(seed: int) -> None:
    check(with_type(UNUSUAL), "test_msgs/msg/Own", Random(seed), rounds=20)


def test_thousands_of_hostile_payloads_read_as_decoded() -> None:
    for number, message in enumerate((pose_stamped(frame_id="map"), odometry(), point_cloud(3))):
        valid = [cdr(message), cdr(message, little_endian=False)]
        payloads = [*hostile.payloads(valid, 1000, seed=number)]
        paths: list[Path] = [("header", "frame_id"), ("pose", "pose", "position", "x"), ("fields", 1, "name")]
        assert 200 < assert_reads_as_decoded(CdrDecoder(message.__msgtype__), paths, payloads) < 990


@pytest.mark.parametrize("raw", [b"\xff\0", b"\xc3\0", b"\xed\xa0\x80\0", b"abc", b""])
def test_a_broken_text_is_refused_where_it_is_skipped(raw: bytes) -> None:
    body = b"\0\1\0\0" + len(raw).to_bytes(4, "little") + raw
    types = with_type("string skipped\nuint8 x")
    assert assert_reads_as_decoded(CdrDecoder("test_msgs/msg/Own", types), [("x",)], [body + b"\1", body]) == 2


def test_many_messages_of_several_layouts_with_some_broken_read_as_decoded() -> None:
    random = Random(1)
    frames = ["map", "odom", "car7/base", "\u00fc", "car8/base"]
    payloads = [cdr(pose_stamped(n, -n, frame_id=random.choice(frames))) for n in range(8 * LEAST)]
    payloads += [cdr(pose_stamped(n), little_endian=False) for n in range(LEAST)]
    for place in random.sample(range(len(payloads)), 40):
        broken = bytearray(payloads[place])
        broken[random.randrange(24)] ^= 1 << random.randrange(8)
        payloads[place] = bytes(broken)
    random.shuffle(payloads)
    paths: list[Path] = [*POSITION, ("header", "frame_id"), ("header", "stamp", "sec"), ("pose", "nowhere")]
    assert 10 < assert_reads_as_decoded(CdrDecoder("geometry_msgs/msg/PoseStamped"), paths, payloads) < 40


def test_many_integers_beyond_doubles_read_as_decoded() -> None:
    random = Random(1)
    types = with_type("bool flag\nint64 a\nuint64 b\nbyte c\nint8 d\nfloat32 e")
    structs = struct.Struct("<4x?7xqQBbxxf")
    payloads = [
        bytearray(structs.pack(n % 2, random.choice((n, -(2**60))), 2**64 - 1 - n, n % 256, n % 256 - 128, n / 3))
        for n in range(4 * LEAST)
    ]
    for payload in payloads:
        payload[1] = 1
    paths: list[Path] = [(name,) for name in ["flag", "a", "b", "c", "d", "e"]]
    decoder = CdrDecoder("test_msgs/msg/Own", types)
    assert assert_reads_as_decoded(decoder, paths, [bytes(payload) for payload in payloads]) == 0


def test_many_texts_and_long_texts_read_as_decoded() -> None:
    payloads = [cdr(make("std_msgs/String", data=f"text {number}")) for number in range(5000)]
    payloads += [cdr(make("std_msgs/String", data="x" * 10_000))] * 2
    assert_reads_as_decoded(CdrDecoder("std_msgs/msg/String"), [("data",)], payloads * 2)


@pytest.mark.parametrize("text", ["float64[0] none\nuint8 x", "string s\nNothing[0] none\nfloat64 x"])
def test_types_with_empty_arrays_are_decoded_whole(text: str) -> None:
    nothing = "\n" + "=" * 80 + "\nMSG: test_msgs/Nothing\n"
    types = with_type(text + (nothing if "Nothing" in text else ""))
    assert CdrDecoder("test_msgs/msg/Own", types).field_reader([("x",)]) is None


def test_types_with_too_many_fields_are_decoded_whole() -> None:
    line = "=" * 80
    doubled = [f"{line}\nMSG: test_msgs/T{n}\n{chr(10).join(f'T{n + 1} f{m}' for m in range(6))}" for n in range(7)]
    deep = "\n".join(["T0 x", *doubled, f"{line}\nMSG: test_msgs/T7\nstring x"])
    assert CdrDecoder("test_msgs/msg/Own", with_type(deep)).field_reader([("x", "f0")]) is None
    nested = [f"{line}\nMSG: test_msgs/S{n}\nS{n + 1}[] x" for n in range(24)]
    loops = "\n".join(["S0[] x", *nested, f"{line}\nMSG: test_msgs/S24\nstring x"])
    assert CdrDecoder("test_msgs/msg/Own", with_type(loops)).field_reader([("x",)]) is None
