"""The folder for files beside the database: a file appears there only when it is complete and on disk."""

from __future__ import annotations

import os
from pathlib import Path

from detector.actions.database.attachments import Attachment
from wayside.process.files import replace_file


class FolderError(Exception):
    """A file could not be written; the message gives the reason."""


class AttachmentFolder:
    """Stores attachments, up to a number of bytes."""

    def __init__(self, path: Path, capacity: int | None) -> None:
        self.path = path
        self._capacity = capacity
        self._used = 0 if capacity is None else _size(path)

    def write(self, attachment: Attachment) -> None:
        """Write it, unless the same file exists. Raises FolderError."""
        target = self.path / attachment.path
        if self._capacity is not None and self._used + len(attachment.content) > self._capacity:
            raise FolderError(f"the folder for files is full ({self._capacity} bytes)")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            replace_file(target, attachment.content, durable=True)
        except OSError as error:
            raise FolderError(f"cannot write a file: {error.strerror or type(error).__name__}") from None
        self._used += len(attachment.content)


def _size(path: Path) -> int:
    total = 0
    for folder, _, names in os.walk(path):
        for name in names:
            try:
                total += (Path(folder) / name).stat().st_size
            except OSError:  # removed in the meantime
                continue
    return total
