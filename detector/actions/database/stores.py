"""One queue per database of the process, shared by its actions; it ends with the last of them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from detector.access.mounted import AccessError, database_uri
from detector.actions.base import ActionError
from detector.actions.database.server import Server
from detector.actions.database.spool import Spool, SpoolError
from detector.actions.database.store import DatabaseWriter
from wayside.api.database import DatabaseConnection, WriteConcern

_FIELD = "spec.database"
_CLOSING = 3.0
"""Seconds at the end to write the queued requests."""

_lock = threading.Lock()
_stores: dict[DatabaseConnection, tuple[DatabaseWriter, int]] = {}


def acquire(database: DatabaseConnection, lose: Callable[[str, int, str], None]) -> DatabaseWriter:
    """The database's queue. Raises ActionError if it cannot be created, without showing secrets."""
    key = _key(database)
    with _lock:
        store, users = _stores.get(key, (None, 0))
        if store is None:
            store = _made(database, lose)
        _stores[key] = (store, users + 1)
        return store


def release(database: DatabaseConnection) -> None:
    """The caller no longer needs the queue."""
    key = _key(database)
    with _lock:
        store, users = _stores[key]
        if users > 1:
            _stores[key] = (store, users - 1)
            return
        del _stores[key]
        store.close(_CLOSING)  # before another one can open the same spool


def _key(database: DatabaseConnection) -> DatabaseConnection:
    return database.model_copy(update={"files": None})


def _made(database: DatabaseConnection, lose: Callable[[str, int, str], None]) -> DatabaseWriter:
    try:
        uri = database_uri(database, _FIELD)
        server = Server(uri, majority=database.write_concern is WriteConcern.MAJORITY)
    except AccessError as error:
        raise ActionError(str(error)) from None
    except ValueError as error:
        raise ActionError(f"{_FIELD}: the connection string is wrong: {error}: write mongodb://…") from None
    try:
        spool = None if database.spool is None else Spool(Path(database.spool.path), database.spool.bytes.bytes)
    except SpoolError as error:
        server.close()
        raise ActionError(f"{_FIELD}.spool.path: {error}") from None
    return DatabaseWriter(server, spool, lose)
