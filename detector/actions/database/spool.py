"""A queue of records on disk, bounded in bytes, that survives the process.

Records are appended to segments (files numbered in order) and synced before they count as stored. They are read in the
same order; a segment is removed once all its records are done, so after a crash some records are repeated. Each record
has its length and a checksum, so truncated records are detected, skipped and reported.
"""

from __future__ import annotations

import fcntl
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_HEAD = struct.Struct("<II")
SEGMENT = 8 * 2**20
"""A segment that has reached this many bytes receives no more records."""


class SpoolError(Exception):
    """The folder cannot be used; the message gives the reason and the remedy."""


@dataclass(slots=True)
class _Segment:
    path: Path
    bytes: int = 0
    records: int = 0
    """Number of records that are not done."""


class Spool:
    """A first-in, first-out queue of records. For one thread."""

    def __init__(self, folder: Path, capacity: int) -> None:
        """Open the queue in a folder, with at most `capacity` bytes. Raises SpoolError."""
        self._folder = folder
        self._capacity = capacity
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = (folder / "lock").open("w")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise SpoolError(f"another process uses the spool {folder}: give each detector its own") from None
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise SpoolError(f"cannot use the spool {folder}: {reason}: correct its path") from None
        self._tail: int | None = None
        self.damaged = 0
        """Bytes of an earlier run's segments that could not be read."""
        self.records = 0
        self.bytes = 0
        self._segments = [_Segment(path) for path in sorted(folder.glob("[0-9]*.spool"))]
        self._offset = 0
        self._current: bytes | None = None
        try:
            self._take_stock()
        except OSError as error:
            self.close()
            raise SpoolError(f"cannot read {error.filename} in the spool: {error.strerror}: remove it") from None

    def _take_stock(self) -> None:
        for segment in self._segments:
            segment.bytes, segment.records = _sound(segment.path)
            size = segment.path.stat().st_size
            if segment.bytes < size:
                self.damaged += size - segment.bytes
                os.truncate(segment.path, segment.bytes)
            self.records += segment.records
            self.bytes += segment.bytes

    def append(self, record: bytes) -> bool:
        """Append a record; False if there is no room. It is stored once `sync` was called.

        Raises OSError if the disk refuses; the queue is then unchanged.
        """
        size = _HEAD.size + len(record)
        if self.bytes + size > self._capacity:
            return False
        if self._tail is None or self._segments[-1].bytes >= SEGMENT:
            self._next_segment()
        assert self._tail is not None  # noqa: S101  made just now
        segment = self._segments[-1]
        content = _HEAD.pack(len(record), zlib.crc32(record)) + record
        try:
            written = 0
            while written < size:
                written += os.write(self._tail, memoryview(content)[written:])
        except OSError:
            os.ftruncate(self._tail, segment.bytes)
            os.lseek(self._tail, segment.bytes, os.SEEK_SET)
            raise
        segment.bytes += size
        segment.records += 1
        self.bytes += size
        self.records += 1
        return True

    def sync(self) -> None:
        """Make sure that appended records survive a loss of power. Raises OSError."""
        if self._tail is not None:
            os.fsync(self._tail)

    def first(self) -> bytes | None:
        """The oldest record, which stays in the queue; None if there is none. Raises OSError."""
        while self._current is None and self._segments:
            with self._segments[0].path.open("rb") as file:
                file.seek(self._offset)
                head = file.read(_HEAD.size)
                if len(head) == _HEAD.size:
                    self._current = file.read(_HEAD.unpack(head)[0])
                    continue
            self._remove()
        return self._current

    def done(self) -> None:
        """Remove the oldest record. Raises OSError."""
        record = self.first()
        if record is None:
            return
        self._offset += _HEAD.size + len(record)
        self._current = None
        self._segments[0].records -= 1
        self.records -= 1
        if self._offset >= self._segments[0].bytes:
            self._remove()

    def give_up(self) -> int:
        """Skip the oldest segment, because it cannot be read; returns the number of records lost."""
        lost = self._segments[0].records
        self.records -= lost
        self._current = None
        self._remove()
        return lost

    def _remove(self) -> None:
        segment = self._segments[0]
        if len(self._segments) == 1:
            self._close_tail()
        self.bytes -= segment.bytes
        del self._segments[0]
        self._offset = 0
        segment.path.unlink(missing_ok=True)

    def _next_segment(self) -> None:
        self._close_tail()
        number = 1 + (int(self._segments[-1].path.stem) if self._segments else 0)
        path = self._folder / f"{number:012d}.spool"
        self._tail = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        self._segments.append(_Segment(path))
        folder = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def _close_tail(self) -> None:
        if self._tail is not None:
            os.fsync(self._tail)
            os.close(self._tail)
            self._tail = None

    def close(self) -> None:
        """Release the folder; the records stay on disk."""
        self._close_tail()
        self._lock.close()


def _sound(segment: Path) -> tuple[int, int]:
    """Up to which byte a segment can be read, and the number of records there."""
    reached = records = 0
    for size in _records(segment):
        reached += size
        records += 1
    return reached, records


def _records(segment: Path) -> Iterator[int]:
    """The sizes of its intact records, including their headers."""
    with segment.open("rb") as file:
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            record = file.read(length)
            if len(record) < length or zlib.crc32(record) != checksum:
                return
            yield _HEAD.size + length
