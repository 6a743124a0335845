"""A queue of records on disk, bounded in bytes, which outlives the process.

Records are appended to segments (files that are numbered in their order) and synced before they count as kept. They
are read in the same order; a segment is removed once all its records are done, so after a crash a few records come
again. Each record carries its length and checksum: what a crash cut off is found and left out, and told.
"""

from __future__ import annotations

import fcntl
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

_HEAD = struct.Struct("<II")
SEGMENT = 8 * 2**20
"""A segment that has reached this many bytes gets no more records."""


class SpoolError(Exception):
    """The folder cannot be used; the text says why and what to do."""


class Spool:
    """A queue of records, first in, first out. For one thread."""

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
            raise SpoolError(f"the spool {folder} is used by another process: give each detector its own") from None
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise SpoolError(f"the spool {folder} cannot be used: {reason}: correct its path") from None
        self._damage = folder / "damaged"
        self.damaged = self._damage.read_text() if self._damage.exists() else ""
        """What of an earlier run's records could not be read; empty where all could."""
        self.records = 0
        self.bytes = 0
        self._segments: list[Path] = sorted(folder.glob("*.spool"))
        self._offset = 0
        self._tail: int | None = None
        self._length = 0
        self._take_stock()

    def _take_stock(self) -> None:
        for number, segment in enumerate(self._segments):
            whole, records = _sound(segment)
            size = segment.stat().st_size
            if whole < size:
                last = number == len(self._segments) - 1
                if not last:  # at the end of all, it is what a crash cut off
                    self.damaged = f"part of the spool could not be read: {segment.name} behind its first {whole} bytes"
                    self._damage.write_text(self.damaged)
                os.truncate(segment, whole)
            self.records += records
            self.bytes += whole

    def append(self, record: bytes) -> bool:
        """Keep a record; False where there is no room. What is appended is kept once `sync` was called.

        Raises OSError where the disk refuses; the queue is then as it was.
        """
        size = _HEAD.size + len(record)
        if self.bytes + size > self._capacity:
            return False
        if self._tail is None or self._length >= SEGMENT:
            self._next_segment()
        assert self._tail is not None  # noqa: S101  made just now
        content = _HEAD.pack(len(record), zlib.crc32(record)) + record
        try:
            written = 0
            while written < size:
                written += os.write(self._tail, memoryview(content)[written:])
        except OSError:
            os.ftruncate(self._tail, self._length)
            os.lseek(self._tail, self._length, os.SEEK_SET)
            raise
        self._length += size
        self.bytes += size
        self.records += 1
        return True

    def sync(self) -> None:
        """Make sure that what was appended outlives a loss of power. Raises OSError."""
        if self._tail is not None:
            os.fsync(self._tail)

    def first(self) -> bytes | None:
        """The oldest record, which stays; None where there is none."""
        while self._segments:
            segment = self._segments[0]
            with segment.open("rb") as file:
                file.seek(self._offset)
                head = file.read(_HEAD.size)
                if len(head) == _HEAD.size:
                    return file.read(_HEAD.unpack(head)[0])
            if self._tail is not None and len(self._segments) == 1:
                self._close_tail()
            self._remove(segment)
        return None

    def done(self) -> None:
        """The oldest record is not needed any more."""
        record = self.first()
        if record is None:
            return
        self._offset += _HEAD.size + len(record)
        self.records -= 1
        self.first()  # removes a segment that is empty now

    def forget_damage(self) -> None:
        """All that could be concerned by it is done."""
        self.damaged = ""
        self._damage.unlink(missing_ok=True)

    def _remove(self, segment: Path) -> None:
        self.bytes -= segment.stat().st_size
        segment.unlink()
        del self._segments[0]
        self._offset = 0

    def _next_segment(self) -> None:
        self._close_tail()
        number = 1 + (int(self._segments[-1].stem) if self._segments else 0)
        path = self._folder / f"{number:012d}.spool"
        self._tail = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        self._length = 0
        self._segments.append(path)
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
        """Let go of the folder; the records stay."""
        self._close_tail()
        self._lock.close()


def _sound(segment: Path) -> tuple[int, int]:
    """Up to which byte a segment can be read, and how many records that are."""
    reached = records = 0
    for size in _records(segment):
        reached += size
        records += 1
    return reached, records


def _records(segment: Path) -> Iterator[int]:
    """The sizes of its records, with their heads, as long as they are whole."""
    with segment.open("rb") as file:
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            record = file.read(length)
            if len(record) < length or zlib.crc32(record) != checksum:
                return
            yield _HEAD.size + length
