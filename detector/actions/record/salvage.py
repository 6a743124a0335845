"""Reads an MCAP file that a process left incomplete: the intact part counts, so that the file can be completed."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import defaultdict
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Header, Metadata, MetadataIndex, Schema

from detector.actions.record.compressing import compressor, decompress
from detector.actions.record.description import METADATA_CUT, METADATA_END
from detector.actions.record.mcap_contents import LIBRARY, MAGIC, Contents, packed_message_indexes
from detector.actions.record.mcap_file import Claim, McapFile, write_at
from wayside.api.actions.record import Compression

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQ")
_UNREADABLE = (EOFError, McapError, UnicodeDecodeError, ValueError, struct.error, KeyError)


def contents_of(path: Path) -> Contents | None:
    """The contents of a complete file; None if it was not completed. Raises OSError."""
    with path.open("rb") as file:
        try:
            summary = SeekingReader(file).get_summary()
        except (*_UNREADABLE, OSError):
            return None
        if summary is None or summary.statistics is None:
            return None
        counts = dict(summary.statistics.channel_message_counts)
        return Contents(dict(summary.schemas), dict(summary.channels), list(summary.chunk_indexes), [counts], [])


def salvage(path: Path, claim: Claim) -> McapFile | None:
    """The file, ready to be completed after its last intact chunk; None if not even its header is intact.

    Raises OSError.
    """
    fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        with open(fd, "rb", closefd=False) as file:
            size = os.fstat(fd).st_size
            reader = _Salvage(file, size)
            if not reader.head():
                os.close(fd)
                return None
            while reader.step():
                pass
        os.ftruncate(fd, reader.end)
        write_at(fd, [reader.missing_index], reader.end)
    except BaseException:
        os.close(fd)
        raise
    end = reader.end + len(reader.missing_index)
    return McapFile(path, compressor(Compression.NONE), claim, fd, reader.contents, end)


class _Salvage:
    """Reads a file record by record, up to the first one that is not intact."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self._size = size
        self.contents = Contents()
        self.end = 0
        """Up to here the file is intact."""
        self.missing_index = b""
        """The missing part of the last chunk's index after that."""

    def head(self) -> bool:
        """Whether it begins like a recording."""
        if self._file.read(len(MAGIC)) != MAGIC:
            return False
        self.end = len(MAGIC)
        try:
            opcode, data = self._record()
            return opcode == Opcode.HEADER and Header.read(_stream(data)).library == LIBRARY
        except _UNREADABLE:
            return False

    def step(self) -> bool:
        """Read the next record; False at the end of the intact part, or of the data."""
        at = self.end
        try:
            opcode, data = self._record()
            match opcode:
                case Opcode.SCHEMA:
                    schema = Schema.read(_stream(data))
                    self.contents.schemas[schema.id] = schema
                case Opcode.CHANNEL:
                    channel = Channel.read(_stream(data))
                    self.contents.channels[channel.id] = channel
                case Opcode.METADATA:
                    name = Metadata.read(_stream(data)).name
                    if name in (METADATA_CUT, METADATA_END):
                        raise EOFError
                    self.contents.metadata.append(MetadataIndex(offset=at, length=self.end - at, name=name))
                case Opcode.CHUNK:
                    return self._chunk(at, Chunk.read(_stream(data)))
                case _:
                    raise EOFError
        except _UNREADABLE:
            self.end = at
            return False
        return True

    def _chunk(self, at: int, chunk: Chunk) -> bool:
        data = decompress(chunk.compression, chunk.data, chunk.uncompressed_size)
        if zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("the chunk's checksum is wrong")
        messages = _messages(data)
        offsets, indexes = packed_message_indexes(messages, self.end)
        self.contents.chunks.append(
            ChunkIndex(
                chunk_length=self.end - at,
                chunk_start_offset=at,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self.contents.counts.append({channel: len(pairs) // 2 for channel, pairs in messages.items()})
        if self._file.read(len(indexes)) == indexes:
            self.end += len(indexes)
            return True
        self.missing_index = indexes
        return False

    def _record(self) -> tuple[int, bytes]:
        """The next intact record. Raises EOFError if there is none."""
        head = self._file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise EOFError
        opcode, length = _RECORD.unpack(head)
        if self.end + _RECORD.size + length > self._size:
            raise EOFError
        data = self._file.read(length)
        self.end += _RECORD.size + length
        return opcode, data


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _messages(data: bytes) -> dict[int, list[int]]:
    """By channel in a chunk, the log times and offsets of its messages. Raises struct.error, ValueError."""
    messages: dict[int, list[int]] = defaultdict(list)
    at = 0
    while at < len(data):
        opcode, length, channel, _, log_time = _MESSAGE.unpack_from(data, at)
        if opcode != Opcode.MESSAGE:
            raise ValueError("a chunk of a recording may contain messages only")
        messages[channel] += (log_time, at)
        at += _RECORD.size + length
    return messages
