"""The rules of files, for a catalog."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from detector.commands.catalog.catalog import Read, entry
from wayside.api import EventRule
from wayside.api.documents import load_documents


def read_files(paths: Sequence[Path]) -> Read:
    """The EventRules of the files and folders; other objects are ignored.

    Raises:
        DocumentError: with every problem of every file.
    """
    return Read(
        tuple(
            entry(document.object, f"{document.file}:{document.line}")
            for document in load_documents(paths)
            if isinstance(document.object, EventRule)
        )
    )
