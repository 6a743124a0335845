"""A queue of requests: in memory, and on disk while the server is away.

The spool's records are always older than those in memory. If both are full, *new* requests are rejected immediately;
requests in the queue are never dropped.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

import bson

from detector.actions.database.spool import Spool
from detector.actions.database.work import Write, unpacked

_log = logging.getLogger(__name__)

MEMORY = 64 * 2**20
"""Maximum bytes in memory."""


class Queue:
    """Several threads add and move to disk, one takes."""

    def __init__(self, spool: Spool | None, lose: Callable[[str, int, str], None]) -> None:
        """`lose` receives the losses of unreadable spool records."""
        self.changed = threading.Condition()
        """Held briefly while the memory changes, and notified of changes."""
        self._disk = threading.Lock()
        """Held while records are moved, taken or removed; acquired before the other lock."""
        self._spool = spool
        self._lose = lose
        self._capacity = MEMORY
        self._memory: deque[Write] = deque()
        self._bytes = 0
        self._inherited = 0 if spool is None else spool.records
        self.full = spool is None
        """The disk accepts nothing more for now."""
        self.damaged = False
        """Some record of the spool could not be read in this run."""
        if spool is not None and spool.damaged:
            lose("bytes of the database's spool", spool.damaged, "corrupted by a crash or by the disk")
        if spool is not None and spool.records:
            _log.info("database: the spool contains %d requests of an earlier run", spool.records)

    @property
    def inherited(self) -> bool:
        """Whether the oldest request comes from an earlier run, whose losses are unknown."""
        return self._inherited > 0

    @property
    def bytes(self) -> int:
        """Bytes that are queued, in memory and on disk."""
        return self._bytes + (0 if self._spool is None else self._spool.bytes)

    def has_room(self, size: int) -> bool:
        """Whether this number of bytes fits into the memory."""
        return not self._bytes or self._bytes + size <= self._capacity

    def add(self, write: Write) -> None:
        """Append it, in memory; `changed` is held."""
        self._memory.append(write)
        self._bytes += write.size
        self.changed.notify_all()

    def first(self) -> Write | None:
        """The oldest request, which stays in the queue; None if there is none."""
        with self._disk:
            if (write := self._from_disk()) is not None:
                return write
            with self.changed:
                return self._memory[0] if self._memory else None

    def _from_disk(self) -> Write | None:
        """The oldest in the spool. Unreadable records are skipped: their scenarios then lack documents."""
        while self._spool is not None:
            try:
                record = self._spool.first()
                return None if record is None else unpacked(record)
            except (OSError, bson.errors.BSONError, KeyError) as error:
                lost = self._spool.give_up()
                self._inherited = max(0, self._inherited - lost)
                self.damaged = True
                self._lose("requests in the database's spool", lost, f"unreadable: {type(error).__name__}")
        return None

    def done(self) -> None:
        """Remove the oldest request."""
        with self._disk, self.changed:
            if self._spool is not None and self._spool.records:
                self._spool.done()
                self.full = False
                self._inherited = max(0, self._inherited - 1)
            elif self._memory:
                self._bytes -= self._memory.popleft().size
            self.changed.notify_all()

    def spill(self) -> None:
        """Move requests from memory to disk, oldest first, as far as there is room."""
        if self._spool is None:
            return
        with self._disk:
            try:
                self.full = not self._move(self._spool)
            except OSError as error:
                if not self.full:
                    _log.warning(
                        "database: the spool accepts no more requests: %s", error.strerror or type(error).__name__
                    )
                self.full = True

    def _move(self, spool: Spool) -> bool:
        """False if there is no more room."""
        moved = 0
        while self._memory:
            write = self._memory[0]
            if not spool.append(write.packed()):
                break
            with self.changed:
                self._memory.popleft()
                self._bytes -= write.size
                self.changed.notify_all()
            moved += 1
        if moved:
            spool.sync()
        return not self._memory

    def close(self) -> list[Write]:
        """Returns the bytes that do not fit on the disk and are lost with the process."""
        self.spill()
        with self._disk, self.changed:
            left = list(self._memory)
            self._memory.clear()
            self._bytes = 0
            if self._spool is not None:
                self._spool.close()
                self._spool = None
            return left
