"""MCAP files without an index: their recorder was killed, or wrote none. They are read record by record.

Everything before the cut is read, including the first messages of an incomplete chunk, as far as its compression
allows.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema

MAGIC = b"\x89MCAP0\r\n"

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
"""The first and the last time, size and checksum of the contents, and the length of the compression's name."""
_MESSAGE = struct.Struct("<HIQ")


class ChunkLocation(NamedTuple):
    """The position of a chunk, or of a message outside of chunks."""

    start: int
    """Its first log time; nanoseconds."""
    offset: int
    length: int
    """Number of bytes present."""
    is_chunk: bool


@dataclass
class UnindexedMcap:
    """The contents of a file without an index."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    places: list[ChunkLocation] = field(default_factory=list)
    cut: str | None = None
    """Where the file ends, if it is truncated."""


def scan_mcap(file: BinaryIO) -> UnindexedMcap:
    """Scans the file. Raises struct.error, ValueError, McapError if its records are damaged."""
    found = UnindexedMcap()
    size = os.fstat(file.fileno()).st_size
    at = len(MAGIC)
    while True:
        file.seek(at)
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            found.cut = "it ends without a footer"
            return found
        opcode, length = _RECORD.unpack(head)
        if not opcode:
            found.cut = f"it has no data from byte {at} on"
            return found
        at += _RECORD.size
        there = min(length, size - at)
        if opcode == Opcode.CHUNK and there >= _CHUNK.size:
            found.places.append(ChunkLocation(_CHUNK.unpack(file.read(_CHUNK.size))[0], at, there, is_chunk=True))
        elif opcode == Opcode.MESSAGE and there == length:
            found.places.append(ChunkLocation(_MESSAGE.unpack(file.read(_MESSAGE.size))[2], at, there, is_chunk=False))
        if there < length:
            found.cut = f"the record at byte {at} has {length} bytes and ends after the end of the file"
            return found
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _define(opcode, file.read(length), found)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return found
        at += length


def messages_at(file: BinaryIO, place: ChunkLocation, contents: UnindexedMcap) -> Iterator[Message]:
    """The messages of a chunk, or the single message; schemas and channels in it are added to the contents.

    Raises ValueError, McapError if the chunk is damaged.
    """
    file.seek(place.offset)
    data = file.read(place.length)
    if not place.is_chunk:
        yield Message.read(_stream(data), place.length)
        return
    name = _CHUNK.unpack_from(data)[-1]
    start = _CHUNK.size + name
    compression = data[_CHUNK.size : start].decode()
    inside = _unpacked(compression, data[start + 8 :])
    at = 0
    while at + _RECORD.size <= len(inside):
        opcode, length = _RECORD.unpack_from(inside, at)
        at += _RECORD.size
        record = inside[at : at + length]
        if len(record) < length:
            return
        if opcode == Opcode.MESSAGE:
            yield Message.read(_stream(record), length)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _define(opcode, record, contents)
        at += length


def _define(opcode: int, data: bytes, contents: UnindexedMcap) -> None:
    if opcode == Opcode.SCHEMA:
        schema = Schema.read(_stream(data))
        contents.schemas[schema.id] = schema
    else:
        channel = Channel.read(_stream(data))
        contents.channels[channel.id] = channel


def _unpacked(compression: str, data: bytes) -> bytes:
    """Decompresses as much as possible of data that may be truncated."""
    unpack: dict[str, Callable[[bytes], bytes]] = {
        "": bytes,
        "lz4": lambda packed: bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed)),
        "zstd": lambda packed: zstandard.ZstdDecompressor().decompressobj().decompress(packed),
    }
    if compression not in unpack:
        raise ValueError(f"unknown MCAP compression {compression!r}")
    return unpack[compression](data)


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))
