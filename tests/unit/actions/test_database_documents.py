"""Samples become documents unchanged; parts that do not fit are stored in files, or truncated and reported."""

from __future__ import annotations

import json
import math
import struct
import zlib
from typing import Any

import bson
import numpy as np
import pytest
from bson import Decimal128
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.actions.database.attachments import detach, pcd, png
from detector.actions.database.documents import LARGEST, Documents, UnfitError, bson_bytes
from detector.actions.episode import EpisodeSample
from detector.streams.codecs import codec_for
from tests.driving import START
from wayside.api.stream import Encoding, Stream

SPEED = Stream(name="speed", key="vehicles/${client:*}/speed", encoding=Encoding.JSON)
BLOB = Stream(name="blob", key="vehicles/${client:*}/blob", encoding=Encoding.RAW)


def documents(above: int | None = None) -> Documents:
    streams = {stream.name: stream for stream in (SPEED, BLOB)}
    decoders = {name: codec_for(stream) for name, stream in streams.items()}
    return Documents("e1.keep", "drives/r/e1.keep", streams, decoders, above)


def sample(payload: bytes, time: int = START, stream: str = "speed", client: str = "car1") -> EpisodeSample:
    return EpisodeSample(client, stream, f"vehicles/{client}/{stream}", time, time, payload)


def test_a_document_has_the_message_its_sender_and_its_time() -> None:
    made = documents().make(sample(b'{"v": 12.5, "unit": "m/s", "list": [1, null, true]}'))
    document = bson.decode(made.document)
    assert made.collection == "json/speed"
    assert document.pop("_id")[:8] == START.to_bytes(8, "big")
    assert document.pop("at").timestamp() == START / 1e9
    assert document == {
        "scenario": "e1.keep",
        "client": "car1",
        "stream": "speed",
        "key": "vehicles/car1/speed",
        "time": START,
        "received": START,
        "msg": {"v": 12.5, "unit": "m/s", "list": [1.0, None, True]},
    }


def test_document_ids_are_unique_and_stable_for_each_sample() -> None:
    samples = [
        sample(b"1"),
        sample(b"1"),  # with clock Data a client may send the same twice at one time
        sample(b"2"),
        sample(b"1", START + 1),
        sample(b"1"),  # late, and once more
        sample(b"1", client="car2"),
        sample(b"1", stream="blob"),
    ]
    first, second = documents(), documents()
    ids = [bson.decode(first.make(each).document)["_id"] for each in samples]
    assert ids == [bson.decode(second.make(each).document)["_id"] for each in samples]
    assert len(set(ids)) == len(samples)


def test_an_undecodable_payload_is_stored_as_received() -> None:
    made = documents().make(sample(b"no json"))
    document = bson.decode(made.document)
    assert made.undecoded
    assert document["payload"] == b"no json"
    assert "not JSON" in document["error"]
    assert "msg" not in document


NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4),
    max_leaves=20,
)


@settings(max_examples=40)
@given(st.dictionaries(NAMES, ANYTHING, max_size=4))
def test_message_values_round_trip_beside_values_that_bson_does_not_support(value: dict[str, Any]) -> None:
    assert bson.decode(bson_bytes({"msg": value}))["msg"] == value
    with_care = bson.decode(bson_bytes({"msg": value, "wide": 2**63}))
    assert with_care["msg"] == value
    assert with_care["wide"] == Decimal128(str(2**63))


def test_numbers_keep_their_values() -> None:
    made = bson_bytes({"a": math.nan, "b": math.inf, "c": 2**60, "d": 2**64 - 1, "e": 10**40, "f": np.float32(0.5)})
    back = bson.decode(made)
    assert math.isnan(back["a"])
    assert back["b"] == math.inf
    assert back["c"] == 2**60
    assert back["d"] == Decimal128(str(2**64 - 1))
    assert back["e"] == str(10**40)
    assert back["f"] == 0.5


def test_numpy_values_names_and_texts_unsupported_by_bson_are_converted() -> None:
    value = {1: np.arange(3), "a\0b": np.int64(5), "text": "\ud800", "set": {1.0}, "view": memoryview(b"ab")}
    back = bson.decode(bson_bytes({"msg": value}))["msg"]
    assert back == {"1": [0, 1, 2], "a\N{SYMBOL FOR NULL}b": 5, "text": "?", "set": [1.0], "view": b"ab"}


def test_a_message_nested_too_deeply_for_mongodb_is_rejected_by_name() -> None:
    value: Any = 2**70
    for _ in range(300):
        value = [value]
    with pytest.raises(UnfitError, match="100 levels"):
        bson_bytes({"msg": value})


def test_a_document_beyond_16_mb_is_stored_whole_in_a_file() -> None:
    numbers = json.dumps([0.5] * 1_500_000).encode()
    made = documents(above=2**16).make(sample(numbers))
    document = bson.decode(made.document)
    assert len(made.document) < 1000
    assert not made.cut
    (file,) = made.files
    assert file.content == numbers
    assert document["payload"]["file"] == file.path
    assert str(LARGEST) in document["note"]


def test_without_a_folder_for_files_documents_too_large_are_truncated_and_reported() -> None:
    made = documents().make(sample(bytes(17 * 2**20), stream="blob"))
    document = bson.decode(made.document)
    assert len(made.document) < 1000
    assert str(LARGEST) in made.cut
    assert document["cut"] == made.cut
    assert not made.files


def test_only_binary_fields_above_the_size_are_stored_in_files() -> None:
    message = {"small": b"x" * 100, "large": b"y" * 101, "text": "z" * 1000, "list": [{"data": b"w" * 200}]}
    slim, files = detach(message, 100, "place")
    assert slim["small"] == b"x" * 100
    assert slim["text"] == "z" * 1000
    assert slim["large"] == files[0].reference()
    assert slim["list"][0]["data"]["file"] == "place-1.bin"
    assert [file.content for file in files] == [b"y" * 101, b"w" * 200]
    assert message["large"] == b"y" * 101, "the message itself is as it was"


def of_png(file: bytes) -> np.ndarray[Any, Any]:
    """Reads the PNG by its own fields; without filters, as in RFC 2083."""
    assert file[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(file):
        (length,) = struct.unpack_from(">I", file, at)
        name, content = file[at + 4 : at + 8], file[at + 8 : at + 8 + length]
        assert struct.unpack_from(">I", file, at + 8 + length)[0] == zlib.crc32(name + content)
        chunks[name] = content
        at += 12 + length
    assert list(chunks) == [b"IHDR", b"IDAT", b"IEND"]
    width, height, depth, colour, *rest = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    assert rest == [0, 0, 0]
    channels = {0: 1, 2: 3, 6: 4}[colour]
    row = width * channels * depth // 8
    lines = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, 1 + row)
    assert not lines[:, 0].any()
    return np.ascontiguousarray(lines[:, 1:]).view(f">u{depth // 8}").reshape(height, width, channels)


@pytest.mark.parametrize(
    ("encoding", "dtype", "channels", "order"),
    [
        ("mono8", "u1", 1, [0]),
        ("rgb8", "u1", 3, [0, 1, 2]),
        ("bgr8", "u1", 3, [2, 1, 0]),
        ("bgra8", "u1", 4, [2, 1, 0, 3]),
        ("mono16", "<u2", 1, [0]),
        ("16UC1", ">u2", 1, [0]),
    ],
)
def test_images_become_png_pixel_by_pixel(encoding: str, dtype: str, channels: int, order: list[int]) -> None:
    pixels = np.random.default_rng(1).integers(0, 200, (5, 7, channels)).astype(dtype)
    rows = pixels.reshape(5, -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, 3)))
    image = {
        "encoding": encoding,
        "width": 7.0,
        "height": 5.0,
        "step": float(padded.shape[1]),
        "is_bigendian": float(dtype.startswith(">")),
        "data": padded.tobytes(),
    }
    file = png(image)
    assert file is not None
    assert (of_png(file) == pixels[:, :, order]).all()


def test_images_without_a_png_equivalent_are_stored_unconverted() -> None:
    image = {"encoding": "32FC1", "width": 2.0, "height": 2.0, "step": 8.0, "is_bigendian": 0.0, "data": bytes(16)}
    assert png(image) is None
    assert png({**image, "encoding": "mono8", "data": b""}) is None
    slim, files = detach(image, 10, "place")
    assert files[0].path == "place.bin"
    assert slim["data"]["format"] == "BIN"


def test_a_compressed_image_keeps_its_format() -> None:
    _, files = detach({"format": "rgb8; jpeg compressed bgr8", "data": b"j" * 200}, 100, "place")
    assert (files[0].path, files[0].content) == ("place.jpg", b"j" * 200)


CLOUD_TYPE = {"names": ["x", "y", "z", "ring"], "formats": ["<f4", "<f4", "<f4", "<u2"], "offsets": [0, 4, 8, 16]}


def cloud(*, big: bool = False, padding: int = 0) -> tuple[dict[str, Any], np.ndarray[Any, Any]]:
    dtype = np.dtype({**CLOUD_TYPE, "itemsize": 20})  # type: ignore[call-overload]
    points = np.zeros((2, 3), dtype)
    rng = np.random.default_rng(1)
    for name in ("x", "y", "z"):
        points[name] = rng.normal(size=(2, 3))
    points["ring"] = rng.integers(0, 60000, (2, 3))
    sent = points.astype(points.dtype.newbyteorder(">")) if big else points
    rows = np.pad(np.frombuffer(sent.tobytes(), np.uint8).reshape(2, -1), ((0, 0), (0, padding)))
    message = {
        "width": 3.0,
        "height": 2.0,
        "point_step": 20.0,
        "row_step": float(60 + padding),
        "is_bigendian": big,
        "fields": [
            {"name": name, "offset": float(offset), "datatype": 4.0 if name == "ring" else 7.0, "count": 1.0}
            for name, offset in zip(CLOUD_TYPE["names"], CLOUD_TYPE["offsets"], strict=True)
        ],
        "data": rows.tobytes(),
    }
    return message, points


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 4])
def test_point_clouds_become_pcd_with_all_their_fields(*, big: bool, padding: int) -> None:
    message, points = cloud(big=big, padding=padding)
    file = pcd(message)
    assert file is not None
    head, _, data = file.partition(b"DATA binary\n")
    logged = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
    assert logged["FIELDS"].split() == ["x", "y", "z", "_", "ring", "_"]
    assert (logged["WIDTH"], logged["HEIGHT"], logged["POINTS"]) == ("3", "2", "6")
    sizes, counts = logged["SIZE"].split(), logged["COUNT"].split()
    assert sum(int(size) * int(count) for size, count in zip(sizes, counts, strict=True)) == 20
    read = np.frombuffer(data, points.dtype).reshape(2, 3)
    for name in points.dtype.names or ():
        assert (read[name] == points[name]).all()


def test_a_point_cloud_with_overlapping_fields_is_not_written_as_pcd() -> None:
    message, _ = cloud()
    message["fields"][1]["offset"] = 2.0
    assert pcd(message) is None
    assert detach(message, 10, "place")[1][0].path == "place.bin"


def test_an_image_with_a_wrong_declared_size_is_stored_unconverted() -> None:
    image = {"encoding": "rgb8", "width": "wide", "height": 2.0, "step": 8.0, "data": bytes(16)}
    assert detach(image, 10, "place")[1][0].path == "place.bin"
