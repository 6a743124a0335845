"""Requests that wait for the database, and their queue: in memory, and on disk while the server is away.

The spool's records are always older than those in memory. If both are full, *new* requests are rejected immediately;
requests in the queue are never dropped.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import bson

from detector.actions.store import DurableStore, StoreError
from wayside.api.database import DatabaseSpool

BATCH_DOCUMENTS = 1000
BATCH_BYTES = 8 * 2**20
"""A request is sent once it has this number of documents, or of bytes."""


@dataclass(frozen=True, slots=True)
class Write:
    """One request: documents to insert, or changes to apply. Requests are idempotent."""

    database: str
    collection: str
    documents: Sequence[bytes] = ()
    """To insert; BSON with an `_id`. An existing one is left unchanged."""
    changes: Sequence[Mapping[str, Any]] = ()
    """Each with `find`, `change` (MongoDB's update) and `many`; without `many`, a missing document is inserted."""
    completes: str = ""
    """The scenario that is complete after this request; earlier requests must have been written."""
    expected: Mapping[str, int] = field(default_factory=dict)
    """By collection, how many documents the scenario must have by then."""
    losing: Callable[[int, str], None] | None = field(default=None, compare=False)
    """Receives the number of refused documents and the reason; None if nothing tracks the request any more."""

    @property
    def size(self) -> int:
        """Approximate size in bytes."""
        return sum(map(len, self.documents)) + 512 * len(self.changes) + 64

    def packed(self) -> bytes:
        """The request as bytes."""
        return bson.encode(
            {
                "database": self.database,
                "collection": self.collection,
                "documents": list(self.documents),
                "changes": list(self.changes),
                "completes": self.completes,
                "expected": dict(self.expected),
            }
        )

    def halves(self) -> tuple[Write, Write]:
        """The documents split into two requests."""
        middle = len(self.documents) // 2
        first, second = self.documents[:middle], self.documents[middle:]
        return (
            Write(self.database, self.collection, first, losing=self.losing),
            Write(self.database, self.collection, second, losing=self.losing),
        )


def unpacked(record: bytes) -> Write:
    """The request from bytes. Raises bson.errors.BSONError or KeyError for anything else."""
    content = bson.decode(record)
    return Write(
        content["database"],
        content["collection"],
        content["documents"],
        content["changes"],
        content["completes"],
        content["expected"],
    )


_log = logging.getLogger(__name__)

MEMORY = 64 * 2**20
"""Maximum bytes in memory."""


class Queue:
    """Several threads add requests and move them to disk; one removes them."""

    def __init__(self, spool: DatabaseSpool | None, lose: Callable[[str, int, str], None]) -> None:
        """`lose` receives the losses of unreadable spool records. Raises StoreError."""
        self.changed = threading.Condition()
        """Held briefly while the memory changes, and notified of changes."""
        self._disk = threading.Lock()
        """Held while records are moved, taken or removed; acquired before the other lock."""
        self._lose = lose
        self._capacity = MEMORY
        self._memory: deque[tuple[str, Write]] = deque()
        """Each with its key in the spool."""
        self._bytes = 0
        self.spools = spool is not None
        """Whether there is a spool that can be used."""
        self.full = not self.spools
        """Whether the disk accepts no more requests for now."""
        self.damaged = False
        """Whether a record of the spool could not be read in this run."""
        self._inherited = 0
        """Number of requests of an earlier run."""
        self._spool = (
            None if spool is None else DurableStore(Path(spool.path) / "spool.db", self._lose_record, spool.bytes.bytes)
        )
        self._keys = map(f"{uuid.uuid4().hex}-{{}}".format, count())
        self._taken = ""
        """The key of the request that `first` returned."""
        if self._spool is not None and self._spool.count:
            self._inherited = self._spool.count
            _log.info("database: the spool contains %d requests of an earlier run", self._inherited)

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
        self._memory.append((next(self._keys), write))
        self._bytes += write.size
        self.changed.notify_all()

    def first(self) -> Write | None:
        """The oldest request, which stays in the queue; None if there is none."""
        with self._disk:
            if (write := self._from_disk()) is not None:
                return write
            with self.changed:
                if not self._memory:
                    return None
                self._taken, write = self._memory[0]
                return write

    def _from_disk(self) -> Write | None:
        """The oldest in the spool. Unreadable records are skipped: their scenarios then lack documents."""
        while self._spool is not None:
            try:
                found = self._spool.first()
                if found is None:
                    return None
                self._taken, record = found
                return unpacked(record)
            except StoreError as error:
                _log.error("database: continuing without the spool until the next start: %s", error)
                self._lose_record(self._spool.count, str(error))
                self._spool, self.spools, self.full = None, False, True
            except (bson.errors.BSONError, KeyError) as error:
                self._lose_record(1, f"unreadable: {type(error).__name__}")
                self._drop(self._taken)
        return None

    def _lose_record(self, count: int, why: str) -> None:
        self.damaged = True
        self._inherited = max(0, self._inherited - count)
        self._lose("requests in the database's spool", count, why)

    def done(self) -> None:
        """Remove the oldest request."""
        with self._disk, self.changed:
            if self._memory and self._memory[0][0] == self._taken:
                self._bytes -= self._memory.popleft()[1].size
            else:
                self._inherited = max(0, self._inherited - 1)
                self._drop(self._taken)
            self.changed.notify_all()

    def _drop(self, key: str) -> None:
        if self._spool is None:
            return
        try:
            self._spool.drop(key)
            self.full = False
        except StoreError as error:
            if not self.full:
                _log.warning("database: a request stays in the spool, and is repeated after a restart: %s", error)
            self.full = True

    def spill(self) -> None:
        """Move requests from memory to disk, oldest first, as far as there is room."""
        if self._spool is None:
            return
        with self._disk:
            try:
                self.full = not self._move(self._spool)
            except StoreError as error:
                if not self.full:
                    _log.warning("database: the spool accepts no more requests: %s", error)
                self.full = True

    def _move(self, spool: DurableStore) -> bool:
        """False if there is no more room."""
        moved = 0
        while self._memory:
            key, write = self._memory[0]
            if not spool.put(key, write.packed()):
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
        """Returns the requests that do not fit on the disk and are lost with the process."""
        self.spill()
        with self._disk, self.changed:
            left = [write for _, write in self._memory]
            self._memory.clear()
            self._bytes = 0
            if self._spool is not None:
                try:
                    self._spool.close()
                except StoreError as error:
                    _log.error("database: cannot close the spool: %s", error)
                self._spool = None
            return left
