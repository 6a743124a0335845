"""What waits for the database: requests in their order, which a spool on disk can hold as bytes."""

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
    """One request: documents to insert, or changes to make. Doing it twice is doing it once."""

    database: str
    collection: str
    documents: Sequence[bytes] = ()
    """To insert; BSON with an `_id`. One that is there already stays as it is."""
    changes: Sequence[Mapping[str, Any]] = ()
    """Each with `find`, `change` (MongoDB's update) and `many`; without `many`, what is not found is made."""
    completes: str = ""
    """The scenario that has all its documents with this; the others before it must have been written."""
    expected: Mapping[str, int] = field(default_factory=dict)
    """By collection, how many documents the scenario must have by then."""
    losing: Callable[[int, str], None] | None = field(default=None, compare=False)
    """Receives the number of refused documents and the reason; None if nothing tracks the request any more."""

    @property
    def size(self) -> int:
        """About how many bytes it holds."""
        return sum(map(len, self.documents)) + 512 * len(self.changes) + 64

    def packed(self) -> bytes:
        """As bytes."""
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
        """Its documents in two requests."""
        middle = len(self.documents) // 2
        first, second = self.documents[:middle], self.documents[middle:]
        return (
            Write(self.database, self.collection, first, losing=self.losing),
            Write(self.database, self.collection, second, losing=self.losing),
        )


def unpacked(record: bytes) -> Write:
    """What was packed. Raises bson.errors.BSONError or KeyError for anything else."""
    content = bson.decode(record)
    return Write(
        content["database"],
        content["collection"],
        content["documents"],
        content["changes"],
        content["completes"],
        content["expected"],
    )
