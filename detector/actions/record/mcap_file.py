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
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Header, Metadata, MetadataIndex, Schema

from detector.actions.record.compressing import Compress, Pieces
from detector.actions.record.mcap_contents import LIBRARY, MAGIC, Contents, packed, packed_message_indexes

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
