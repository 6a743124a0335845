"""Writes an MCAP file without copying large messages, so that a truncated file can still be completed.

Messages are collected in a chunk in memory. A chunk is passed to the kernel in one call, preceded by new schemas and
channels, and followed by its index. Payloads are passed by reference: point clouds cost no copies, and other threads
run during the call. Data in the kernel survives the process. If a write fails, the file is truncated to the last whole
chunk, so it never contains a partial one; the messages of the failed chunk are lost and counted.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from wayside.api.actions.record import Compression

Pieces = Sequence[bytes | bytearray]
"""A chunk, not joined."""
Compress = Callable[[Pieces], tuple[str, Pieces]]
"""Compresses a chunk; also returns MCAP's name of the compression."""


def compressor(compression: Compression) -> Compress:
    """The function that compresses the chunks of one recording; for one thread."""
    match compression:
        case Compression.NONE:
            return lambda pieces: ("", pieces)
        case Compression.LZ4:
            return lambda pieces: ("lz4", (lz4.frame.compress(b"".join(pieces)),))
        case Compression.ZSTD:
            zstd = zstandard.ZstdCompressor(level=1)  # almost as fast as lz4, and much smaller
            return lambda pieces: ("zstd", (zstd.compress(b"".join(pieces)),))


def decompress(name: str, data: bytes, size: int) -> bytes:
    """The chunk of `size` bytes. Raises ValueError if it cannot be read."""
    try:
        match name:
            case "":
                return data
            case "lz4":
                return bytes(lz4.frame.decompress(data))
            case "zstd":
                return zstandard.decompress(data, max_output_size=size)
    except (RuntimeError, zstandard.ZstdError) as error:
        raise ValueError(str(error)) from error
    raise ValueError(f"unknown compression {name!r}")


MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "wayside recording 1"
"""The library in the header; the number is the version of the recording's contents."""

_INDEX_HEAD = struct.Struct("<BQHI")

ChunkMessages = Mapping[int, list[int]]
"""By channel of a chunk: the log time of a message (nanoseconds), its offset in the chunk, those of the next …"""


def packed(record: McapRecord) -> bytes:
    """The record in its binary form."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def packed_message_indexes(messages: ChunkMessages, at: int) -> tuple[dict[int, int], bytes]:
    """The message indexes that follow a chunk, at that offset of the file, and the offset of each channel's index."""
    offsets: dict[int, int] = {}
    data = bytearray()
    for channel, pairs in messages.items():
        offsets[channel] = at + len(data)
        data += _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(pairs), channel, 8 * len(pairs))
        data += struct.pack(f"<{len(pairs)}Q", *pairs)
    return offsets, bytes(data)


@dataclass(slots=True)
class Contents:
    """Schemas, channels, chunks and metadata of a file, in the order of the file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    counts: list[Mapping[int, int]] = field(default_factory=list)
    """By chunk, the number of messages of each channel."""
    metadata: list[MetadataIndex] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """Number of messages in the chunks."""
        return sum(sum(counts.values()) for counts in self.counts)

    @property
    def by_channel(self) -> Mapping[int, int]:
        """Number of messages of each channel in the chunks."""
        total: Counter[int] = Counter()
        for counts in self.counts:
            total.update(counts)
        return total

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last log time; zeros if there are no messages."""
        if not self.chunks:
            return 0, 0
        return (
            min(chunk.message_start_time for chunk in self.chunks),
            max(chunk.message_end_time for chunk in self.chunks),
        )

    def summary(self, start: int) -> bytes:
        """Everything that follows the end of the data, which is at offset `start`."""
        first, last = self.span
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.by_channel),
            chunk_count=len(self.chunks),
            message_count=self.messages,
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )
        data = bytearray()
        offsets = bytearray()
        groups: tuple[tuple[Opcode, Iterable[McapRecord]], ...] = (
            (Opcode.SCHEMA, self.schemas.values()),
            (Opcode.CHANNEL, self.channels.values()),
            (Opcode.STATISTICS, (statistics,)),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.METADATA_INDEX, self.metadata),
        )
        for opcode, records in groups:
            begin = len(data)
            for record in records:
                data += packed(record)
            if len(data) > begin:
                offset = SummaryOffset(group_opcode=opcode, group_start=start + begin, group_length=len(data) - begin)
                offsets += packed(offset)
        offset_start = start + len(data)
        data += offsets
        checksum = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start), zlib.crc32(data))
        data += packed(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=checksum))
        return bytes(data + MAGIC)


_CHUNK = 2**20
"""Approximate maximum bytes of a chunk of more than one message."""
_APART = 2**15
"""Payloads of at least this many bytes are not copied; smaller ones are copied into one buffer."""
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK_HEAD = struct.Struct("<BQQQQI")
_ENDING = 512
"""Bytes that complete a file, apart from its summary's entries for chunks, schemas and channels."""

Claim = Callable[[int, int], None]
"""Called before bytes are written: how many now, and how many more when the file is completed. Raises an error if there
is no room. Negative numbers: they were not written."""


class SyncError(OSError):
    """The kernel could not write accepted data to the disk; it is unknown how much was written."""


class McapFile:
    """A file in progress. After any of its exceptions (OSError, or those of `claim`), it can still be completed."""

    def __init__(self, path: Path, compress: Compress, claim: Claim, fd: int, contents: Contents, end: int) -> None:
        """An existing file: the contents are valid up to `end`, and the rest is ignored."""
        self.path = path
        self.contents = contents
        self.end = end
        """Number of bytes that are completely written."""
        self.lost = 0
        """Messages that were added, but are not in the file because a write failed."""
        self._compress = compress
        self._claim = claim
        self._fd = fd
        self._new = b""
        self._later = 0
        self._begin_chunk()

    @classmethod
    def create(cls, path: Path, profile: str, compress: Compress, claim: Claim) -> McapFile:
        """A new file."""
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        file = cls(path, compress, claim, fd, Contents(), 0)
        try:
            file._write([MAGIC, packed(Header(profile, LIBRARY))], _ENDING)
        except BaseException:
            file.give_up()
            path.unlink()
            raise
        return file

    def _begin_chunk(self) -> None:
        self._pieces: list[bytes | bytearray] = []
        self._run = bytearray()  # the data after the pieces, while it is small
        self._size = 0
        self._first = self._last = 0
        self._index: dict[int, list[int]] = defaultdict(list)
        self.waiting = 0
        """Number of messages that are not in the kernel yet."""

    @property
    def size(self) -> int:
        """Number of bytes written and queued, the latter uncompressed."""
        return self.end + self._size

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; returns its number."""
        number = len(self.contents.schemas) + 1
        self.contents.schemas[number] = Schema(id=number, name=name, encoding=encoding, data=data)
        self._new += packed(self.contents.schemas[number])
        return number

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel; returns its number. Schema 0: none."""
        number = len(self.contents.channels) + 1
        self.contents.channels[number] = Channel(
            id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=dict(metadata)
        )
        self._new += packed(self.contents.channels[number])
        return number

    def add(self, channel: int, sequence: int, log_time: int, publish_time: int, payload: bytes) -> None:
        """Add a message, which is written with its chunk. Times are nanoseconds since the epoch."""
        length = len(payload)
        if self.waiting and self._size + length > _CHUNK:
            try:
                self.flush()
            except BaseException:
                self.lost += 1
                raise
        if not self.waiting:
            self._first = self._last = log_time
        elif log_time < self._first:
            self._first = log_time
        elif log_time > self._last:
            self._last = log_time
        self._index[channel] += (log_time, self._size)
        self._run += _MESSAGE.pack(Opcode.MESSAGE, length + 22, channel, sequence, log_time, publish_time)
        if length < _APART:
            self._run += payload
        else:
            self._pieces += (self._run, payload)
            self._run = bytearray()
        self._size += _MESSAGE.size + length
        self.waiting += 1
        if self._size >= _CHUNK:
            self.flush()

    def flush(self) -> None:
        """Passes queued messages to the kernel."""
        if not self.waiting:
            return
        pieces, size, messages = [*self._pieces, self._run], self._size, dict(self._index)
        first, last, waiting = self._first, self._last, self.waiting
        self._begin_chunk()
        try:
            self._write_chunk(pieces, size, messages, first, last)
        except BaseException:
            self.lost += waiting
            raise

    def _write_chunk(self, pieces: Pieces, size: int, messages: Mapping[int, list[int]], first: int, last: int) -> None:
        checksum = 0
        for piece in pieces:
            checksum = zlib.crc32(piece, checksum)
        name, body = self._compress(pieces)
        length = sum(map(len, body))
        compression = name.encode()
        middle = struct.pack(f"<I{len(compression)}sQ", len(compression), compression, length)
        head = _CHUNK_HEAD.pack(Opcode.CHUNK, 28 + len(middle) + length, first, last, size, checksum)
        at = self.end + len(self._new)
        chunk = len(head) + len(middle) + length
        offsets, indexes = packed_message_indexes(messages, at + chunk)
        entry = ChunkIndex(
            chunk_length=chunk,
            chunk_start_offset=at,
            compression=name,
            compressed_size=length,
            message_end_time=last,
            message_index_length=len(indexes),
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=size,
        )
        self._write([self._new, head, middle, *body, indexes], len(packed(entry)) + 2 * len(self._new))
        self._new = b""
        self.contents.chunks.append(entry)
        self.contents.counts.append({channel: len(pairs) // 2 for channel, pairs in messages.items()})

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record, which tools such as Foxglove display."""
        self.flush()
        record = packed(Metadata(name=name, metadata=dict(data)))
        index = MetadataIndex(offset=self.end, length=len(record), name=name)
        self._write([record], len(packed(index)))
        self.contents.metadata.append(index)

    def drop_last_chunk(self) -> bool:
        """Remove the last chunk and all after it, to make room for completing the file. False if there is none."""
        if not self.contents.chunks:
            return False
        self.end = self.contents.chunks.pop().chunk_start_offset
        self.lost += sum(self.contents.counts.pop().values())
        self.contents.metadata = [each for each in self.contents.metadata if each.offset < self.end]
        os.ftruncate(self._fd, self.end)
        return True

    def finish(self) -> None:
        """Completes and closes the file, after syncing it. It can be retried, except after a SyncError."""
        self.flush()
        end, later = self.end, self._later
        tail = [self._new, packed(DataEnd(0))]
        self._write([*tail, self.contents.summary(end + sum(map(len, tail)))], -later)
        try:
            os.fsync(self._fd)
        except OSError as error:
            raise SyncError(*error.args) from error
        finally:
            self.give_up()

    def give_up(self) -> None:
        """Closes the file without completing it."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _write(self, pieces: Pieces, later: int) -> None:
        size = sum(map(len, pieces))
        self._claim(size, later)
        try:
            write_at(self._fd, pieces, self.end)
        except BaseException:
            self._claim(-size, -later)
            os.ftruncate(self._fd, self.end)
            raise
        self.end += size
        self._later += later


def write_at(fd: int, pieces: Pieces, offset: int) -> None:
    """Write all pieces in sequence, from that offset. Raises OSError."""
    waiting = [memoryview(piece) for piece in pieces if piece]
    while waiting:
        written = os.pwritev(fd, waiting[:1024], offset)
        offset += written
        while waiting and written >= len(waiting[0]):
            written -= len(waiting[0])
            del waiting[0]
        if waiting and written:
            waiting[0] = waiting[0][written:]
