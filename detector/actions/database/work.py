"""Requests that wait for the database, in a form that a spool on disk can store."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import bson

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
