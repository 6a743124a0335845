"""Files that are replaced as a whole: no reader sees a part of one, and a killed process leaves none."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def replace_file(path: Path, content: bytes | str, *, draft: Path | None = None, durable: bool = False) -> None:
    """Write the file under another name in its folder, and rename it when it is complete.

    Args:
        path: the file.
        content: bytes, or text that becomes UTF-8.
        draft: the other name; None: hidden, the same for every process that writes this file.
        durable: whether the content is on disk before the file is renamed.

    Raises:
        OSError: it could not be written; the file is as before.
    """
    draft = draft or path.with_name(f".{path.name}.new")
    try:
        with draft.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise


def sync_folder(folder: Path) -> None:
    """Wait until the names of the folder's files are on disk: otherwise a loss of power might bring the old ones back.

    Raises OSError.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
