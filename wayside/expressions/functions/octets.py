"""Functions on bytes, such as a payload or an image, without converting them to a list."""

from __future__ import annotations

import struct
import zlib
from typing import Final

from wayside.expressions.functions.declaring import ResultType, function

_FORMATS: Final = {
    name: struct.Struct(code)
    for name, code in {
        "u8": "B",
        "i8": "b",
        **{f"{kind}{order}": f"{'<' if order == 'le' else '>'}{code}" for order in ("le", "be") for kind, code in (
            ("u16", "H"), ("i16", "h"), ("u32", "I"), ("i32", "i"), ("f32", "f"), ("f64", "d")
        )},
    }.items()
}  # fmt: skip


def all_zero(data: bytes) -> bool:
    """Whether all bytes are 0; true for no bytes."""
    return not bytes(data).strip(b"\0") if len(data) < 4096 else bytes(data).count(0) == len(data)


def checksum(data: bytes) -> float:
    """The CRC-32 of ISO 3309 (as in zip and Ethernet)."""
    return float(zlib.crc32(data))


def byte_count(data: bytes) -> float:
    """The number of bytes."""
    return float(memoryview(data).nbytes)


def number_at(data: bytes, offset: float, form: str) -> float:
    """The number that begins at a byte: format u8, i8, u16le, i32be, f32le, …"""
    known = _FORMATS.get(form)
    if known is None:
        raise ValueError(f"format must be one of {', '.join(_FORMATS)}; got {form!r}")
    if offset != int(offset) or not 0 <= offset <= len(data) - known.size:
        raise ValueError(f"no value for bytes {offset:g} to {offset + known.size - 1:g}: there are {len(data)}")
    return float(known.unpack_from(data, int(offset))[0])


def utf8(data: bytes) -> str:
    """The bytes decoded as UTF-8; NUL becomes `␀`."""
    try:
        return bytes(data).decode().replace("\0", "␀")
    except UnicodeDecodeError as error:
        raise ValueError(f"the bytes are not valid UTF-8: {error.reason} at byte {error.start}") from None


FUNCTIONS = (
    function("allZero", ResultType.BOOLEAN, "whether all bytes are 0", (all_zero, "data:bytes")),
    function("checksum", ResultType.NUMBER, "the CRC-32 of the bytes", (checksum, "data:bytes")),
    function("byteCount", ResultType.NUMBER, "the number of bytes", (byte_count, "data:bytes")),
    function(
        "numberAt",
        ResultType.NUMBER,
        "the number that begins at byte offset (counted from 0), as u8, i8, or u16, i16, u32, i32, f32, f64 followed "
        "by le or be",
        (number_at, "data:bytes offset format:string"),
    ),
    function("utf8", ResultType.TEXT, "the bytes as a UTF-8 string", (utf8, "data:bytes")),
)
