"""The queue before the server: what is put into it is written in its order, each once, or counted as lost.

It begins in memory. While the server is away, what is there moves to the spool on disk, whose records are always older
than what is in memory. Where neither has room, what is *new* is dropped: so scenarios that are in the queue stay whole,
and whoever puts learns it at once. One queue and one thread serve all database actions of the process.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import bson

from detector.actions.database import scenario as scenarios
from detector.actions.database.server import RefusedError, Server, UnavailableError
from detector.actions.database.spool import Spool
from detector.actions.database.work import Write, unpacked

_log = logging.getLogger(__name__)

MEMORY = 64 * 2**20
"""So many bytes wait in memory at most."""
_LONGEST = 5.0
"""Between two attempts lie at most so many seconds."""
_SUSPECT = 3
"""After so many connections that ended with one request, while the server answers others, it is the request."""

_PATIENCE = 10
"""So many tenths of a second somebody who puts waits for room before the disk is asked."""

_LAST_TRY = 0.5
"""At the end, a server that is away gets so many seconds more."""

_ANEW = 1.0
"""After an unexpected error the queue rests so many seconds."""

Confirm = Callable[[bool, str], None]
"""Told that a scenario is complete in the database, or that it is not, and why."""


class Store:
    """The queue, and the thread that empties it."""

    def __init__(self, server: Server, spool: Spool | None, lose: Callable[[str, int, str], None]) -> None:
        """`lose` is told what is lost of an earlier run's records."""
        self._server = server
        self._spool = spool
        self._lose = lose
        self._capacity = MEMORY
        self._lock = threading.Condition()
        self._disk = threading.Lock()
        """Held while records are moved, taken or removed; never together with a request to the server."""
        self._left = False
        self._memory: deque[Write] = deque()
        self._bytes = 0
        self._away = ""
        self._closing = False
        self._deadline = 0.0
        self._confirms: dict[str, Confirm] = {}
        self._seen: set[Any] = set()
        self._inherited = 0 if spool is None else spool.records
        """So many records at the head of the spool are an earlier run's: it is not known what it lost before them."""
        self._doubts = not server.sure
        """Documents may be missing of which it is not known: each scenario's are counted before it is completed."""
        if spool is not None and spool.damaged:
            lose("bytes of the database's spool", spool.damaged, "a crash or the disk damaged them")
        if spool is not None and spool.records:
            _log.info("database: %d requests of an earlier run wait in the spool", spool.records)
        self.written = 0
        """Documents that are in the database."""
        self._thread = threading.Thread(target=self._work, name="database", daemon=True)
        self._thread.start()

    @property
    def away(self) -> str:
        """Why the server cannot be written to; empty while it can."""
        return self._away

    @property
    def waiting(self) -> int:
        """How many bytes wait, in memory and on disk."""
        return self._bytes + (0 if self._spool is None else self._spool.bytes)

    def first_time(self, what: object) -> bool:
        """Whether it is asked for the first time."""
        with self._lock:
            new = what not in self._seen
            self._seen.add(what)
            return new

    def put(self, write: Write, closing: threading.Event) -> bool:
        """Queue documents. Waits while the server is only slow; False where there is no room: they are dropped."""
        size = write.size
        waited = 0
        while True:
            with self._lock:
                if self._left:
                    return False
                if not self._bytes or self._bytes + size <= self._capacity:
                    self._add(write, size)
                    return True
                nowhere = self._away and (self._spool is None or self._stuck)
                ending = closing.is_set() or self._closing
                if nowhere or (ending and waited >= _PATIENCE):
                    return False
                if not ending:
                    self._lock.wait(0.1)
            waited = _PATIENCE if ending else waited + 1
            if waited >= _PATIENCE:  # the server hangs on a request, or there is no time: the disk makes room
                self._spill()

    def put_change(self, write: Write, confirm: Confirm | None = None) -> None:
        """Queue what is said about scenarios: small, and never dropped."""
        with self._lock:
            if not self._left:
                if confirm is not None:
                    self._confirms[write.completes] = confirm
                self._add(write, write.size)
                return
        if confirm is not None:
            confirm(False, self._end_text())

    _stuck = False
    """The spool takes nothing more for now."""

    def _add(self, write: Write, size: int) -> None:
        self._memory.append(write)
        self._bytes += size
        self._lock.notify_all()

    def close(self, seconds: float) -> None:
        """Write what there is, at most for so long; the rest goes to the spool, or is lost where there is none."""
        with self._lock:
            self._closing = True
            self._deadline = time.monotonic() + (seconds if not self._away else min(seconds, _LAST_TRY))
            self._lock.notify_all()
        self._thread.join(seconds + 1)
        if self._thread.is_alive():  # a request hangs; whether it was done or not, its documents come again
            self._leave()
        self._server.close()

    # The thread; only it speaks to the server.

    def _work(self) -> None:
        while not self._late():
            try:
                write = self._next()
                if write is None:
                    break
                if self._send(write):
                    self._took(write)
            except Exception as error:  # noqa: BLE001  a defect, or a disk: the queue goes on, since doing twice is doing once
                self._lose("times the database's queue had to begin anew", 1, self._server.redact(error))
                _log.error("database: the queue begins anew: %s", type(error).__name__)
                _log.debug("in the queue", exc_info=error)
                time.sleep(_ANEW)
        self._leave()

    def _late(self) -> bool:
        return self._closing and time.monotonic() >= self._deadline

    def _next(self) -> Write | None:
        """The oldest request, which stays where it is; None at the end."""
        while True:
            with self._disk:
                if (record := self._from_disk()) is not None:
                    return record
                with self._lock:
                    if self._memory:
                        return self._memory[0]
            with self._lock:
                if not self._memory:
                    if self._closing:
                        return None
                    self._lock.wait(1)

    def _from_disk(self) -> Write | None:
        """The oldest request in the spool. What cannot be read is left out: its scenarios then lack documents."""
        while self._spool is not None:
            try:
                record = self._spool.first()
                return None if record is None else unpacked(record)
            except (OSError, bson.errors.BSONError, KeyError) as error:
                lost = self._spool.give_up()
                self._inherited = max(0, self._inherited - lost)
                self._doubts = True
                self._lose("requests in the database's spool", lost, f"unreadable: {type(error).__name__}")
        return None

    def _took(self, write: Write) -> None:
        """The oldest request is done."""
        with self._disk, self._lock:
            if self._left:
                return
            if self._spool is not None and self._spool.records:
                self._spool.done()
                self._stuck = False
                self._inherited = max(0, self._inherited - 1)
            elif self._memory:
                self._memory.popleft()
                self._bytes -= write.size
            self._lock.notify_all()

    def _send(self, write: Write, patience: int = _SUSPECT) -> bool:
        """Write it, however often that takes; False where there is no more time.

        `patience`: after so many connections that ended with it, documents are looked for that are to blame.
        """
        pause, broke = 0.05, 0
        while True:
            try:
                lacking = self._server.lacks(write) if self._doubts or self._inherited else ""
                matched, refused = self._server.write(scenarios.give_up(write, lacking) if lacking else write)
            except RefusedError as error:
                return self._divide(write, str(error))
            except UnavailableError as error:
                self._note_away(str(error))
                broke = broke + 1 if error.broke and self._server.answers() else 0
                if broke >= patience:
                    return self._divide(write, "the server ends the connection when it gets it")
                if error.broke and broke:
                    pause = 0.05  # it is there
                if not self._pause(pause * random.uniform(0.7, 1.3)):  # noqa: S311  no secret
                    return False
                pause = min(_LONGEST, pause * 2)
                continue
            self._note_back()
            self.written += len(write.documents) - (len(refused) if write.documents else 0)
            if not all(self._reject(write, each.index, each.why) for each in refused):
                return False
            if write.completes:
                self._confirm(write, matched, lacking or (refused[0].why if refused else ""))
            return True

    def _divide(self, write: Write, why: str) -> bool:
        """Find the documents that cannot be written among those that can."""
        if len(write.documents) > 1:
            return all(self._send(half, 1 if len(half.documents) > 1 else _SUSPECT) for half in write.halves())
        if not self._reject(write, 0, why):
            return False
        if write.completes:
            self._confirm(write, 0, why)
        return True

    def _reject(self, write: Write, index: int, why: str) -> bool:
        """A document is lost: its scenario must not become complete, whatever happens now.

        False where that could not be written: then the request must come again.
        """
        lose = write.losing or self._lost_earlier
        if not write.documents:
            lose(1, f"the database refused a change of {write.collection}: {why}")
            return True
        scenario = bson.decode(write.documents[index]).get("scenario", "")
        if not self._send(scenarios.reject(write.database, scenario, why)):
            return False
        lose(1, f"the database refused it: {why}")
        return True

    def _lost_earlier(self, count: int, why: str) -> None:
        self._lose("database documents", count, why)

    def _confirm(self, write: Write, matched: int, why: str) -> None:
        confirm = self._confirms.pop(write.completes, None)
        if confirm is not None:
            confirm(bool(matched) and not why, why or "the database refused some of it")

    def _pause(self, seconds: float) -> bool:
        """Wait before the next attempt; what comes meanwhile goes to the disk. False where there is no more time."""
        until = time.monotonic() + seconds
        while True:
            self._spill()
            with self._lock:
                left = until - time.monotonic()
                if left <= 0 or self._late():
                    return not self._late()
                self._lock.wait(min(left, 0.2))

    def _spill(self) -> None:
        """Move what is in memory to the disk, oldest first, as far as there is room."""
        spool = self._spool
        if spool is None:
            return
        with self._disk:
            try:
                self._stuck = not self._move(spool)
            except OSError as error:
                if not self._stuck:
                    _log.warning("database: the spool takes nothing more: %s", error.strerror or type(error).__name__)
                self._stuck = True

    def _move(self, spool: Spool) -> bool:
        """False where there is no room for more."""
        moved = 0
        while self._memory:
            write = self._memory[0]
            if not spool.append(write.packed()):
                break
            with self._lock:
                self._memory.popleft()
                self._bytes -= write.size
                self._lock.notify_all()
            moved += 1
        if moved:
            spool.sync()
        return not self._memory

    def _leave(self) -> None:
        """What is not written waits on disk for the next run, or is lost."""
        self._spill()
        with self._lock:
            if self._left:
                return
            self._left = True
            for write in self._memory:
                if write.documents:
                    lose = write.losing or self._lost_earlier
                    lose(len(write.documents), "the detector ended before it was written")
            self._memory.clear()
            confirms, self._confirms = self._confirms, {}
        for confirm in confirms.values():
            confirm(False, self._end_text())
        if self._spool is not None:
            self._spool.close()

    def _end_text(self) -> str:
        where = "what is not written waits in the spool" if self._spool is not None else "there is no spool"
        return f"the detector ended before the database had it ({self._away or 'it was busy'}); {where}"

    def _note_away(self, why: str) -> None:
        if not self._away:
            where = "waits in the spool on disk" if self._spool is not None else "waits in memory: there is no spool"
            _log.warning("database: cannot be written to: %s; what comes %s", why, where)
        self._away = why

    def _note_back(self) -> None:
        if self._away:
            _log.info("database: can be written to again; %d bytes wait", self.waiting)
            self._away = ""
