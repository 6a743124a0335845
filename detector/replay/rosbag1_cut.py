"""ROS 1 bags that were not closed: they have no index, so they are read record by record.

A bag (format 2.0) is a sequence of records, each with a header of named fields and data. The data of a chunk are again
records, possibly compressed: connections and messages.
"""

from __future__ import annotations

import bz2
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")

_UNPACK: dict[str, Callable[[bytes], bytes]] = {
    "none": bytes,
    "bz2": lambda data: bz2.BZ2Decompressor().decompress(data),
    "lz4": lambda data: bytes(lz4.frame.LZ4FrameDecompressor().decompress(data)),
}
"""Decompresses as much as possible of data that may be truncated."""


class BagMessage(NamedTuple):
    """One message."""

    time: int
    """Nanoseconds since the epoch."""
    connection: int
    payload: bytes


class Chunk(NamedTuple):
    """The position of a chunk's data, their compression, and the time of its first message (nanoseconds)."""

    start: int
    offset: int
    length: int
    compression: str


@dataclass
class UnindexedBag:
    """The contents of a bag without an index."""

    connections: dict[int, Connection] = field(default_factory=dict)
    chunks: list[Chunk] = field(default_factory=list)
    cut: str | None = None
    """Where the bag ends, if it is truncated."""


def scan_bag(path: Path, magic: bytes) -> UnindexedBag:
    """Scans the bag. Raises OSError, ValueError, LookupError, struct.error if its records are damaged."""
    found = UnindexedBag()
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        at = len(magic)
        while at < size:
            file.seek(at)
            header = _header(file)
            length = _length(file)
            if header is None or length is None:
                found.cut = f"it ends inside a record's header at byte {at}"
                return found
            at = file.tell()
            there = min(length, size - at)
            if header["op"][0] == _CHUNK:
                data = file.read(there)
                compression = header["compression"].decode()
                times = [each.time for each in _messages(data, compression, found)]
                if times:
                    found.chunks.append(Chunk(min(times), at, there, compression))
            if there < length:
                found.cut = f"the record at byte {at} has {length} bytes and ends after the end of the file"
                return found
            at += length
    found.cut = "it was not closed"
    return found


def chunk_messages(path: Path, chunk: Chunk, contents: UnindexedBag) -> Iterator[BagMessage]:
    """The messages of a chunk, in the order of the file."""
    with path.open("rb") as file:
        file.seek(chunk.offset)
        return _messages(file.read(chunk.length), chunk.compression, contents)


def _messages(data: bytes, compression: str, contents: UnindexedBag) -> Iterator[BagMessage]:
    if compression not in _UNPACK:
        raise ValueError(f"unknown bag compression {compression!r}")
    inside = _UNPACK[compression](data)
    at = 0
    while (found := _record(inside, at)) is not None:
        header, body, at = found
        match header["op"][0]:
            case op if op == _CONNECTION:
                connection = _connection(header, body)
                contents.connections[connection.id] = connection
            case op if op == _MESSAGE:
                seconds, nanoseconds = _TIME.unpack(header["time"])
                number = _LENGTH.unpack(header["conn"])[0]
                yield BagMessage(seconds * 10**9 + nanoseconds, number, body)


def _connection(header: dict[str, bytes], body: bytes) -> Connection:
    described = _fields(body)
    return Connection(
        _LENGTH.unpack(header["conn"])[0],
        header["topic"].decode(),
        normalize_msgtype(described["type"].decode()),
        MessageDefinition(MessageDefinitionFormat.MSG, described["message_definition"].decode(errors="replace")),
        described["md5sum"].decode(),
        0,
        ConnectionExtRosbag1(None, None),
        None,
    )


def _record(data: bytes, at: int) -> tuple[dict[str, bytes], bytes, int] | None:
    """Header and data of a record, and its end; None if it is incomplete."""
    parts = []
    for _ in range(2):
        if at + _LENGTH.size > len(data):
            return None
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if at + length > len(data):
            return None
        parts.append(data[at : at + length])
        at += length
    return _fields(parts[0]), parts[1], at


def _header(file: BinaryIO) -> dict[str, bytes] | None:
    length = _length(file)
    data = b"" if length is None else file.read(length)
    return None if length is None or len(data) < length else _fields(data)


def _length(file: BinaryIO) -> int | None:
    data = file.read(_LENGTH.size)
    return int(_LENGTH.unpack(data)[0]) if len(data) == _LENGTH.size else None


def _fields(data: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        name, _, value = data[at + _LENGTH.size : at + _LENGTH.size + length].partition(b"=")
        fields[name.decode()] = value
        at += _LENGTH.size + length
    return fields
