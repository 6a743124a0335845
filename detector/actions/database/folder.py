"""The folder for files beside the database: a file appears there only when it is complete and on disk."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from detector.actions.database.attachments import Attachment


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
        unfinished = target.with_name(f".{target.name}.unfinished")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with unfinished.open("wb") as file:
                file.write(attachment.content)
                file.flush()
                os.fsync(file.fileno())
            unfinished.replace(target)
        except OSError as error:
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)
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
