"""Writes to the MongoDB server: one request at a time, and without revealing credentials."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote_plus

import pymongo
from bson.errors import BSONError
from bson.raw_bson import RawBSONDocument
from pymongo import MongoClient, UpdateMany, UpdateOne, WriteConcern
from pymongo.errors import (
    AutoReconnect,
    BulkWriteError,
    ConnectionFailure,
    DocumentTooLarge,
    NetworkTimeout,
    NotPrimaryError,
    OperationFailure,
    PyMongoError,
    ServerSelectionTimeoutError,
)

from detector.actions.database.queue import Write

_log = logging.getLogger(__name__)
logging.getLogger("pymongo").setLevel(logging.INFO)  # it would log every document

_DUPLICATE = 11000
_SECONDS = 10.0
"""Maximum time in seconds of one request before the connection counts as broken."""


_COUNTING = 60.0
"""Maximum time in seconds to count a scenario's documents."""


class DatabaseUnavailableError(Exception):
    """The server is unavailable; a later attempt may succeed."""

    def __init__(self, text: str, *, broke: bool = False) -> None:
        super().__init__(text)
        self.broke = broke
        """The connection ended during this request, which may be the cause."""


class WriteRefusedError(Exception):
    """The whole request is impossible, now and later; the message gives the reason."""


@dataclass(frozen=True, slots=True)
class RefusedWrite:
    """One document or change that the server rejects."""

    index: int
    why: str


class Redactor:
    """Removes the secrets of a connection string from texts."""

    def __init__(self, uri: str) -> None:
        secrets = {uri}
        found = re.match(r"[^:/]*://(?P<rest>.*)", uri, re.DOTALL)
        rest = found["rest"] if found else uri
        login, at, _ = rest.rpartition("@")
        if at:
            user, _, password = login.partition(":")
            secrets |= {login, password, unquote_plus(password), unquote_plus(login)}
            if not password:
                secrets.add(user)
            secrets |= {part for part in re.split(r"[@/]", password) if len(part) > 2}
        for name, value in re.findall(r"[?&]([^=&]+)=([^&]*)", rest):
            if re.search("password|token|secret|authmechanismproperties", name, re.IGNORECASE):
                secrets |= {value, unquote_plus(value)}
        self._secrets = sorted((secret for secret in secrets if secret), key=len, reverse=True)

    def __call__(self, text: object) -> str:
        """The text without secrets."""
        clean = str(text)
        for secret in self._secrets:
            clean = clean.replace(secret, "***")
        return clean if len(clean) <= 500 else clean[:500] + "…"


class Server:
    """A connection to the server, opened on first use."""

    def __init__(self, uri: str, *, majority: bool) -> None:
        """Raises ValueError if the connection string is wrong, without showing it."""
        self.redact = Redactor(uri)
        self.sure = majority
        """Whether written documents are durable."""
        self._indexed: set[tuple[str, str]] = set()
        self._concern = WriteConcern("majority" if majority else 1, wtimeout=int(_SECONDS * 500))
        self._sure = WriteConcern("majority", wtimeout=int(_SECONDS * 500))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # an option that the driver would ignore, and print with its value
                self._client: MongoClient[Any] = MongoClient(
                    uri,
                    appname="wayside",
                    connect=False,
                    serverSelectionTimeoutMS=1000,
                    connectTimeoutMS=3000,
                    socketTimeoutMS=int(_SECONDS * 1000),
                    retryWrites=False,  # the queue retries, in order
                )
        except (PyMongoError, ValueError, TypeError, Warning) as error:
            raise ValueError(self.redact(error)) from None

    def write(self, write: Write) -> tuple[int, list[RefusedWrite]]:
        """Execute it; returns the number of documents that the changes matched, and the rejected parts.

        Raises DatabaseUnavailableError, WriteRefusedError.
        """
        with self._driver_errors():
            try:
                return self._insert(write) if write.documents else self._change(write)
            except BulkWriteError as error:
                return 0, self._refused(error.details, inserting=bool(write.documents))

    def lacks(self, write: Write) -> str:
        """The documents missing from the scenario that the request completes; empty if there are none.

        Raises DatabaseUnavailableError, WriteRefusedError.
        """
        with self._driver_errors(), pymongo.timeout(_COUNTING):
            for collection, count in sorted(write.expected.items()):
                found = self._client[write.database][collection].count_documents({"scenario": write.completes})
                if found < count:
                    return f"the database has only {found} of {count} documents in {collection}"
        return ""

    @contextmanager
    def _driver_errors(self) -> Iterator[None]:
        """Converts the driver's errors to ours."""
        try:
            yield
        except DocumentTooLarge as error:
            raise WriteRefusedError(self.redact(error)) from None
        except ConnectionFailure as error:
            broke = isinstance(error, AutoReconnect) and not isinstance(
                error, NetworkTimeout | NotPrimaryError | ServerSelectionTimeoutError
            )
            raise DatabaseUnavailableError(self._short(error), broke=broke) from None
        except PyMongoError as error:
            raise DatabaseUnavailableError(self._short(error)) from None
        except (BSONError, OverflowError, ValueError, TypeError) as error:
            raise WriteRefusedError(self.redact(error)) from None

    def _insert(self, write: Write) -> tuple[int, list[RefusedWrite]]:
        collection = self._client.get_database(write.database, write_concern=self._concern)[write.collection]
        if (write.database, write.collection) not in self._indexed:
            try:
                collection.create_index("scenario")  # the filter of most queries
            except OperationFailure as error:  # continue without it
                _log.warning("database: cannot create the index on %s: %s", write.collection, self._short(error))
            self._indexed.add((write.database, write.collection))
        collection.insert_many([RawBSONDocument(document) for document in write.documents], ordered=False)
        return len(write.documents), []

    def _change(self, write: Write) -> tuple[int, list[RefusedWrite]]:
        requests = [
            UpdateMany(each["find"], each["change"])
            if each["many"]
            else UpdateOne(each["find"], each["change"], upsert=True)
            for each in write.changes
        ]
        collection = self._client.get_database(write.database, write_concern=self._sure)[write.collection]
        done = collection.bulk_write(requests, ordered=False)
        return done.matched_count, []

    def _refused(self, details: Mapping[str, Any], *, inserting: bool) -> list[RefusedWrite]:
        """The rejected parts of a request; documents that exist already are fine.

        Raises DatabaseUnavailableError if the rest is not durable yet, or another client created the same at the same
        time.
        """
        if not inserting and any(_there_already(each) for each in details.get("writeErrors", ())):
            raise DatabaseUnavailableError("another client is writing the same document")
        refused = [
            RefusedWrite(int(each["index"]), self.redact(each.get("errmsg", "")))
            for each in details.get("writeErrors", ())
            if not _there_already(each)
        ]
        concerns: Sequence[Mapping[str, Any]] = details.get("writeConcernErrors", ())
        if concerns:
            raise DatabaseUnavailableError(self.redact(concerns[0].get("errmsg", "the write concern is not satisfied")))
        return refused

    def _short(self, error: PyMongoError) -> str:
        """The error, without the driver's description of its topology."""
        text = str(error).partition(", Topology Description")[0].partition(" (configured timeouts")[0]
        return self.redact(text.partition(", full error:")[0])

    def answers(self) -> bool:
        """Whether the server responds."""
        try:
            self._client.admin.command("ping")
        except PyMongoError:
            return False
        return True

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


def _there_already(error: Mapping[str, Any]) -> bool:
    return error.get("code") == _DUPLICATE and error.get("keyPattern", {"_id": 1}) == {"_id": 1}
