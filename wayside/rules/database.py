"""Checks that a Detector has what a database action needs."""

from __future__ import annotations

from collections.abc import Iterator

from wayside.api import Detector
from wayside.api.actions.database import DatabaseAction
from wayside.api.wording import FieldPath


def database_problems(action: DatabaseAction, detector: Detector) -> Iterator[tuple[FieldPath, str]]:
    """The missing fields; the paths begin at the action."""
    database = detector.spec.database
    if database is None:
        yield (
            ("database",),
            f"Detector {detector.name} has no spec.database: add it, e.g. {{uriVariable: MONGODB_URI}}",
        )
    elif action.files is not None and database.files is None:
        yield (
            ("database", "files"),
            f"Detector {detector.name} has no spec.database.files: add it with a path, or remove files",
        )
