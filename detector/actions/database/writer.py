"""Writes requests in order, each exactly once, or counts them as lost.

A separate thread sends the queued requests and retries until the server accepts them. Rejected documents are isolated
from the accepted ones. All database actions of the process share one queue and one thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import bson

from detector.access import AccessError, database_uri
from detector.actions.base import ActionError
from detector.actions.database import scenario as scenarios
from detector.actions.database.queue import Queue, Write
from detector.actions.database.server import DatabaseUnavailableError, Server, WriteRefusedError
from detector.actions.store import StoreError
from wayside.api.database import DatabaseConnection, DatabaseSpool, WriteConcern
from wayside.process.backoff import Backoff, retry

_log = logging.getLogger(__name__)

_FIRST, _LONGEST = 0.1, 5.0
"""Seconds between two attempts."""
_SUSPECT = 3
"""Number of connections lost during one request, while the server responds otherwise, that make it the suspect."""

_PATIENCE = 10
"""Tenths of a second that a producer waits for room before the disk is used."""

_LAST_TRY = 0.5
"""Additional seconds at the end for a server that is unavailable."""

_RESTART_DELAY = 1.0
"""Seconds that the queue pauses after an unexpected error."""

_FIELD = "spec.database"
_CLOSING = 3.0
"""Seconds at the end to write the queued requests."""

Confirm = Callable[[bool, str], None]
"""Called with whether a scenario is complete in the database, and the reason if it is not."""


class DatabaseWriter:
    """The queue, and the thread that empties it."""

    def __init__(self, server: Server, spool: DatabaseSpool | None, lose: Callable[[str, int, str], None]) -> None:
        """`lose` receives the losses among the records of an earlier run. Raises StoreError."""
        self._server = server
        self._lose = lose
        self._queue = Queue(spool, lose)
        self._lock = self._queue.changed
        self._left = False
        self._away = ""
        self._closing = False
        self._deadline = 0.0
        self._confirms: dict[str, Confirm] = {}
        self._seen: set[Any] = set()
        self._doubts = not server.sure
        """Documents may be missing without notice: each scenario's are counted before it is completed."""
        self.written = 0
        """Number of documents in the database."""
        self._thread = threading.Thread(target=self._work, name="database", daemon=True)
        self._thread.start()

    @property
    def away(self) -> str:
        """Why the server cannot be written to; empty if it can."""
        return self._away

    @property
    def waiting(self) -> int:
        """Number of bytes that are queued, in memory and on disk."""
        return self._queue.bytes

    def first_time(self, what: object) -> bool:
        """Whether this is the first call."""
        with self._lock:
            new = what not in self._seen
            self._seen.add(what)
            return new

    def put(self, write: Write, closing: threading.Event) -> bool:
        """Queue documents. Waits while the server is only slow; False if there is no room: they are dropped."""
        waited = 0
        while True:
            with self._lock:
                if self._left:
                    return False
                if self._queue.has_room(write.size):
                    self._queue.add(write)
                    return True
                nowhere = self._away and self._queue.full
                ending = closing.is_set() or self._closing
                if nowhere or (ending and waited >= _PATIENCE):
                    return False
                if not ending:
                    self._lock.wait(0.1)
            waited = _PATIENCE if ending else waited + 1
            if waited >= _PATIENCE:  # the server hangs on a request, or there is no time: use the disk to make room
                self._queue.spill()

    def put_change(self, write: Write, confirm: Confirm | None = None) -> None:
        """Enqueue a change of a scenario: small, and never dropped."""
        with self._lock:
            if not self._left:
                if confirm is not None:
                    self._confirms[write.completes] = confirm
                self._queue.add(write)
                return
        if confirm is not None:
            confirm(False, self._end_text())

    def close(self, seconds: float) -> None:
        """Write queued requests, for at most this time; the rest goes to the spool, or is lost without one."""
        with self._lock:
            self._closing = True
            self._deadline = time.monotonic() + (seconds if not self._away else min(seconds, _LAST_TRY))
            self._lock.notify_all()
        self._thread.join(seconds + 1)
        if self._thread.is_alive():  # a request hangs; done or not, its documents will be sent again
            self._leave()
        self._server.close()

    # The thread; only this code uses the server.

    def _work(self) -> None:
        retry(self._empty, Exception, self._restart)  # a defect, or a disk: requests are idempotent
        self._leave()

    def _empty(self) -> None:
        while not self._late() and (write := self._next()) is not None:
            if self._send(write) and not self._left:
                self._queue.done()

    def _restart(self, error: Exception) -> float:
        self._lose("times the database queue was restarted", 1, self._server.redact(error))
        _log.error("database: restarting the queue: %s", type(error).__name__)
        _log.debug("the database queue failed", exc_info=error)
        return _RESTART_DELAY

    def _late(self) -> bool:
        return self._closing and time.monotonic() >= self._deadline

    def _next(self) -> Write | None:
        """The oldest request, which stays in the queue; None at the end."""
        while (write := self._queue.first()) is None:
            with self._lock:
                if self._closing:
                    return None
                if self._queue.bytes == 0:
                    self._lock.wait(1)
        return write

    def _send(self, write: Write, patience: int = _SUSPECT) -> bool:
        """Write it, with retries; False if there is no more time.

        `patience`: after this number of connections lost during it, search for the documents that cause this.
        """
        backoff, broke = Backoff(_FIRST, _LONGEST), 0

        def attempt() -> bool:
            if broke >= patience:
                return self._divide(write, "the server closes the connection when it receives this request")
            if backoff.failures and self._late():
                return False
            try:
                doubts = self._doubts or self._queue.damaged or self._queue.inherited
                missing = self._server.lacks(write) if doubts else ""
                matched, refused = self._server.write(scenarios.give_up(write, missing) if missing else write)
            except WriteRefusedError as error:
                return self._divide(write, str(error))
            self._note_back()
            self.written += len(write.documents) - (len(refused) if write.documents else 0)
            if not all(self._reject(write, each.index, each.why) for each in refused):
                return False
            if write.completes:
                self._confirm(write, matched, missing or (refused[0].why if refused else ""))
            return True

        def failed(error: DatabaseUnavailableError) -> float:
            nonlocal broke
            self._note_away(str(error))
            broke = broke + 1 if error.broke and self._server.answers() else 0
            if broke >= patience:
                return 0.0
            if error.broke and broke:
                backoff.succeed()  # it is there
            return backoff.fail()

        return retry(attempt, DatabaseUnavailableError, failed, self._pause)

    def _divide(self, write: Write, why: str) -> bool:
        """Separate the documents that cannot be written from those that can."""
        if len(write.documents) > 1:
            return all(self._send(half, 1 if len(half.documents) > 1 else _SUSPECT) for half in write.halves())
        if not self._reject(write, 0, why):
            return False
        if write.completes:
            self._confirm(write, 0, why)
        return True

    def _reject(self, write: Write, index: int, why: str) -> bool:
        """A document is lost: its scenario must never become complete.

        False if that could not be written: then the request must be repeated.
        """
        lose = write.losing or self._lost_earlier
        if not write.documents:
            lose(1, f"the database rejected a change of {write.collection}: {why}")
            return True
        scenario = bson.decode(write.documents[index]).get("scenario", "")
        if not self._send(scenarios.reject(write.database, scenario, why)):
            return False
        lose(1, f"the database rejected the document: {why}")
        return True

    def _lost_earlier(self, count: int, why: str) -> None:
        self._lose("database documents", count, why)

    def _confirm(self, write: Write, matched: int, why: str) -> None:
        confirm = self._confirms.pop(write.completes, None)
        if confirm is not None:
            confirm(bool(matched) and not why, why or "the database rejected a part of the scenario")

    def _pause(self, seconds: float) -> None:
        """Wait before the next attempt, but not beyond the end; new requests go to the disk."""
        until = time.monotonic() + seconds
        while True:
            self._queue.spill()
            with self._lock:
                left = until - time.monotonic()
                if left <= 0 or self._late():
                    return
                self._lock.wait(min(left, 0.2))

    def _leave(self) -> None:
        """Leave unwritten requests on disk for the next run; count the others as lost."""
        with self._lock:
            if self._left:
                return
            self._left = True
        for write in self._queue.close():
            if write.documents:
                lose = write.losing or self._lost_earlier
                lose(len(write.documents), "the detector stopped before it wrote the document")
        confirms, self._confirms = self._confirms, {}
        for confirm in confirms.values():
            confirm(False, self._end_text())

    def _end_text(self) -> str:
        where = "unwritten requests stay in the spool" if self._queue.spools else "there is no spool"
        return f"the detector stopped before the database stored the scenario ({self._away or 'it was busy'}); {where}"

    def _note_away(self, why: str) -> None:
        if not self._away:
            where = "in the spool on disk" if self._queue.spools else "in memory, because there is no spool"
            _log.warning("database: cannot write: %s; new data is queued %s", why, where)
        self._away = why

    def _note_back(self) -> None:
        if self._away:
            _log.info("database: writing again; %d bytes are queued", self.waiting)
            self._away = ""


_lock = threading.Lock()
_writers: dict[DatabaseConnection, tuple[DatabaseWriter, int]] = {}
"""The writers of the process with the number of their users, each for one database."""


def acquire(database: DatabaseConnection, lose: Callable[[str, int, str], None]) -> DatabaseWriter:
    """The database's writer. Raises ActionError if it cannot be created, without showing secrets."""
    key = _key(database)
    with _lock:
        writer, users = _writers.get(key, (None, 0))
        if writer is None:
            writer = _made(database, lose)
        _writers[key] = (writer, users + 1)
        return writer


def release(database: DatabaseConnection) -> None:
    """The caller no longer needs the writer, which ends with its last user."""
    key = _key(database)
    with _lock:
        writer, users = _writers[key]
        if users > 1:
            _writers[key] = (writer, users - 1)
            return
        del _writers[key]
        writer.close(_CLOSING)  # before another one can open the same spool


def _key(database: DatabaseConnection) -> DatabaseConnection:
    return database.model_copy(update={"files": None})


def _made(database: DatabaseConnection, lose: Callable[[str, int, str], None]) -> DatabaseWriter:
    try:
        uri = database_uri(database, _FIELD)
        server = Server(uri, majority=database.write_concern is WriteConcern.MAJORITY)
    except AccessError as error:
        raise ActionError(str(error)) from None
    except ValueError as error:
        raise ActionError(f"{_FIELD} must be a connection string mongodb://…: {error}") from None
    try:
        return DatabaseWriter(server, database.spool, lose)
    except StoreError as error:
        server.close()
        raise ActionError(f"{_FIELD}.spool.path: {error}") from None
