"""Files that are replaced atomically: no reader sees a partial file, and a killed process leaves none."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def replace_file(
    path: Path, content: bytes | str, *, draft: Path | None = None, durable: bool = False, private: bool = False
) -> None:
    """Write the content to another file in the same folder, and rename that file when it is complete.

    Args:
        path: the file.
        content: bytes, or text, which is encoded as UTF-8.
        draft: the other file; None: a hidden file, the same for every process that writes this file.
        durable: whether to sync the content to disk before the file is renamed.
        private: whether only its owner may read it.

    Raises:
        OSError: the content could not be written; the file is unchanged.
    """
    draft = draft or path.with_name(f".{path.name}.new")
    try:
        with draft.open("wb") as file:
            if private:
                os.fchmod(file.fileno(), 0o600)
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
    """Sync the folder to disk, so that renamed files keep their new names after a power loss.

    Raises OSError.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
