"""Records on disk that actions have yet to deliver: they survive a kill -9 until they are dropped.

Each store is one SQLite file, locked while it is open. A record survives the process as soon as it is put, and a power
failure once `sync` has returned. Nothing here waits for a lock or for another thread.
"""

from __future__ import annotations

import glob
import json
import logging
import os
import sqlite3
import uuid
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)

_SETTINGS = (
    "locking_mode = EXCLUSIVE",  # works without shared memory, which network filesystems lack
    "journal_mode = WAL",  # a commit needs no fsync, and a power failure damages nothing
    "synchronous = NORMAL",
    "wal_autocheckpoint = 256",
    "secure_delete = OFF",  # some builds of SQLite would write zeros over each dropped record
)
_TABLE = """CREATE TABLE IF NOT EXISTS records
    (id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL UNIQUE, record BLOB NOT NULL, checksum INTEGER NOT NULL)"""
_CORRUPT = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_PAGES = 256
"""An empty file of more pages than this is shrunk."""

Lose = Callable[[int, str], None]
"""Receives the number of records that cannot be read, and the reason."""


class StoreError(Exception):
    """The store or its disk refuses; the message names the file, the reason and the remedy."""


class StoreInUseError(StoreError):
    """The file is open elsewhere, in this process or another."""


class DurableStore:
    """Records by key, oldest first. Not thread-safe."""

    def __init__(self, path: Path, lose: Lose, capacity: int | None = None) -> None:
        """Open the file, with the records of earlier runs; it is bounded by `capacity` bytes. Raises StoreError."""
        self._path, self._lose, self._capacity = path, lose, capacity
        self._hidden: set[str] = set()
        """Keys of records in the file that are unreadable, or dropped although the disk refused."""
        self.count = self.bytes = 0
        """Of the records that are not hidden."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._open()
        except OSError as error:
            raise self._error(error) from None
        except sqlite3.Error as error:
            self._recover(error)

    def put(self, key: str, record: bytes) -> bool:
        """Store a record, or replace the one of that key; False if there is no room. Raises StoreError."""
        before = self._sizes(key)
        size = len(record) - sum(before.values())
        if self._capacity is not None and self.bytes + size > self._capacity:
            return False
        self._run(
            "INSERT INTO records (key, record, checksum) VALUES (?, ?, ?) "
            "ON CONFLICT (key) DO UPDATE SET record = excluded.record, checksum = excluded.checksum",
            key,
            record,
            zlib.crc32(record),
        )
        self._hidden.discard(key)
        self.bytes += size
        self.count += not before
        return True

    def sync(self) -> None:
        """Return once all records survive a power failure. Raises StoreError."""
        self._run("PRAGMA wal_checkpoint(PASSIVE)")

    def get(self, key: str) -> bytes | None:
        """The record; None if there is none that can be read. Raises StoreError."""
        if key in self._hidden:
            return None
        why = "its checksum is wrong"
        try:
            rows = self._db.execute("SELECT record, checksum FROM records WHERE key = ?", (key,)).fetchall()
            if all(zlib.crc32(record) == checksum for record, checksum in rows):
                return bytes(rows[0][0]) if rows else None
        except sqlite3.Error as error:
            if _code(error) not in _CORRUPT:
                raise self._error(error) from None
            why = str(error)
        self._hide(key)
        self._lose(1, f"cannot read a record of {self._path}: {why}")
        return None

    def keys(self, prefix: str) -> list[str]:
        """The keys that begin with `prefix`, oldest first. Raises StoreError."""
        return [key for key in self._keys(-1) if key.startswith(prefix)]

    def first(self) -> tuple[str, bytes] | None:
        """The oldest record that can be read, after its key; None if there is none. Raises StoreError."""
        while keys := self._keys(1 + len(self._hidden)):
            if (record := self.get(keys[0])) is not None:
                return keys[0], record
        return None

    def drop(self, *keys: str) -> None:
        """Remove records. Raises StoreError if the disk refuses: they then reappear after a restart."""
        self._hide(*keys)
        self._run("DELETE FROM records WHERE key IN (SELECT value FROM json_each(?))", json.dumps(keys))
        self._hidden.difference_update(keys)
        if not self.count and self._run("PRAGMA page_count")[0][0] > _PAGES:
            self._run("VACUUM")
            self.sync()

    def close(self) -> None:
        """Leave the file to the next run, or remove it if it is empty. Raises StoreError."""
        try:
            if not self.count:
                self._db.execute("PRAGMA journal_mode = DELETE")
                self._path.unlink(missing_ok=True)
        except (sqlite3.Error, OSError) as error:
            raise self._error(error) from None
        finally:
            self._db.close()

    def _open(self) -> None:
        if not self._path.exists():  # to close a file that is open here as well would release its lock
            self._path.touch(0o600)
        self._db = sqlite3.connect(self._path, timeout=0, isolation_level=None, check_same_thread=False)
        try:
            for context in _SETTINGS:
                self._db.execute(f"PRAGMA {context}")
            self._db.execute(_TABLE)
            query = "SELECT count(*), coalesce(sum(length(record)), 0) FROM records"
            self.count, self.bytes = self._db.execute(query).fetchone()
        except sqlite3.Error:
            self._db.close()
            raise
        if not self._path.exists():  # its last user removed it between our opening and locking
            self._db.close()
            raise StoreInUseError(f"{self._path} was removed while it was opened: try again")

    def _sizes(self, *keys: str) -> dict[str, int]:
        """The sizes of those records that count."""
        query = "SELECT key, length(record) FROM records WHERE key IN (SELECT value FROM json_each(?))"
        rows = self._run(query, json.dumps(keys))
        return {key: size for key, size in rows if key not in self._hidden}

    def _hide(self, *keys: str) -> None:
        sizes = self._sizes(*keys)
        self._hidden.update(sizes)
        self.count -= len(sizes)
        self.bytes -= sum(sizes.values())

    def _keys(self, limit: int) -> list[str]:
        rows = self._run("SELECT key FROM records ORDER BY id LIMIT ?", limit)
        return [key for (key,) in rows if key not in self._hidden]

    def _run(self, statement: str, *values: object) -> list[Any]:
        try:
            return self._db.execute(statement, values).fetchall()
        except sqlite3.Error as error:
            self._recover(error)
        try:
            return self._db.execute(statement, values).fetchall()
        except sqlite3.Error as error:
            raise self._error(error) from None

    def _recover(self, error: sqlite3.Error) -> None:
        """Set a corrupt file aside, in place of an earlier one, and begin a new one. Raises StoreError otherwise."""
        if _code(error) not in _CORRUPT:
            raise self._error(error) from None
        self._db.close()
        self._lose(max(1, self.count), f"{self._path}: {error}")
        aside = f"{self._path}.unreadable"
        try:
            for suffix in ("", "-wal"):
                with suppress(FileNotFoundError):
                    os.replace(f"{self._path}{suffix}", f"{aside}{suffix}")
            self._hidden.clear()
            self._open()
        except (sqlite3.Error, OSError) as refused:
            raise self._error(refused) from None
        _log.error(
            "cannot read %s; renamed it and started a new one: `sqlite3 %s .recover` prints the remaining records",
            self._path,
            aside,
        )

    def _error(self, error: Exception) -> StoreError:
        if _code(error) == sqlite3.SQLITE_BUSY:
            return StoreInUseError(f"another process uses {self._path}: give each detector its own")
        if _code(error) == sqlite3.SQLITE_FULL:
            return StoreError(f"cannot write {self._path}: the disk is full: free space on it")
        why = error.strerror if isinstance(error, OSError) else error
        return StoreError(f"cannot use {self._path}: {why}: check the path, its disk and the rights on it")


def action_store(folder: Path, name: str, lose: Lose) -> DurableStore:
    """The store of an action, with the records that earlier runs left in `folder` under `name`. Raises StoreError.

    A changed action runs beside its predecessor while that completes its episodes. Each has a file of its own, and
    takes over the files that nobody uses.
    """
    stores: list[DurableStore] = []
    for path in sorted(folder.glob(f"{glob.escape(name)}.????????.db")):
        with suppress(StoreInUseError):
            stores.append(DurableStore(path, lose))
    own, *others = stores or [DurableStore(folder / f"{name}.{uuid.uuid4().hex[:8]}.db", lose)]
    for other in others:
        for key in other.keys(""):
            if (record := other.get(key)) is not None:
                own.put(key, record)
        own.sync()  # else a power failure could keep neither copy
        other.drop(*other.keys(""))
        other.close()
    return own


def _code(error: Exception) -> int:
    """SQLite's primary result code; 0 for other errors."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF
