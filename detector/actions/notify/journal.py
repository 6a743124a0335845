"""Undelivered events, in a file that survives a kill -9.

One JSON object per line: `{"put": key, "document": {…}}` or `{"drop": [keys]}`. Data passed to the operating system
survives the process; a power failure may lose the last seconds. A truncated last line is skipped. The file is rewritten
atomically when it holds many dropped documents.

A changed action runs beside its predecessor while that has episodes to complete. Each has a file that it locks, and
takes over files that are not locked.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

_log = logging.getLogger(__name__)

_FILES = 16
"""Maximum number of files of an action: its own, and those of predecessors that are still running."""
_SLACK = 1 << 20
"""Maximum bytes of dropped documents in a file beyond those of live ones."""


class JournalError(Exception):
    """The journal cannot be opened; the message gives the reason."""


class Journal:
    """Documents by key. Not thread-safe."""

    def __init__(self, folder: Path, name: str) -> None:
        """Take over the files of earlier runs in `folder` under `name`. Raises JournalError."""
        self.live: dict[str, dict[str, Any]] = {}
        """Documents that were put and not dropped, oldest first."""
        self.unreadable = 0
        """Invalid lines in the files of earlier runs, except a truncated last one."""
        self._sizes: dict[str, int] = {}
        self._live_bytes = self._written = 0
        taken: list[tuple[Path, BinaryIO]] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for number in range(_FILES):
                path = folder / f"{name}.{number}.jsonl"
                if taken and not path.exists():
                    continue
                file = _locked(path)
                if file is not None:
                    taken.append((path, file))
                    self._read(file)
        except OSError as error:
            raise JournalError(f"cannot write {folder} ({error.strerror})") from error
        if not taken:
            raise JournalError(f"{folder} already has {_FILES} journals of {name} in use")
        self._path, self._file = taken[0]
        try:
            self._rewrite()
            for path, file in taken[1:]:
                path.unlink()
                file.close()
        except OSError as error:
            raise JournalError(f"cannot write {folder} ({error.strerror})") from error

    def put(self, key: str, document: Mapping[str, Any]) -> None:
        """Store a document. Raises OSError if the disk refuses; it is then not stored."""
        line = _line({"put": key, "document": document})
        self._append(line)
        self._remember(key, dict(document), len(line))

    def drop(self, keys: Iterable[str]) -> None:
        """Remove documents. Raises OSError if the disk refuses: they then reappear after a restart."""
        known = [key for key in keys if key in self.live]
        if not known:
            return
        for key in known:
            del self.live[key]
            self._live_bytes -= self._sizes.pop(key)
        self._append(_line({"drop": known}))
        if self._written > 2 * self._live_bytes + _SLACK:
            self._rewrite()

    def close(self) -> None:
        """Leave the file to the next run, or remove it if it is empty. Raises OSError."""
        if not self.live:
            self._path.unlink(missing_ok=True)
        self._file.close()

    def _remember(self, key: str, document: dict[str, Any], size: int) -> None:
        self._live_bytes += size - self._sizes.get(key, 0)
        self.live[key], self._sizes[key] = document, size

    def _append(self, line: bytes) -> None:
        begun = self._file.tell()
        if self._file.write(line) != len(line):
            self._file.truncate(begun)  # remove a partial line
            self._file.seek(begun)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._written += len(line)

    def _read(self, file: BinaryIO) -> None:
        file.seek(0)
        for line in file:
            try:
                entry = json.loads(line)
                if "put" in entry:
                    self._remember(str(entry["put"]), dict(entry["document"]), len(line))
                for key in entry.get("drop", ()):
                    if self.live.pop(key, None) is not None:
                        self._live_bytes -= self._sizes.pop(key)
            except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
                self.unreadable += line.endswith(b"\n")

    def _rewrite(self) -> None:
        """Write only live documents; the file keeps its lock, so it is replaced by one that is locked as well."""
        lines = b"".join(_line({"put": key, "document": document}) for key, document in self.live.items())
        draft = self._path.with_suffix(".new")
        file = draft.open("w+b", buffering=0)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if file.write(lines) != len(lines):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.replace(draft, self._path)
        except OSError:
            file.close()
            raise
        self._file.close()
        self._file, self._written = file, len(lines)


def _locked(path: Path) -> BinaryIO | None:
    """The file, created if it is missing; None if it is locked."""
    file = path.open("a+b", buffering=0)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    if not path.exists() or os.stat(path).st_ino != os.fstat(file.fileno()).st_ino:
        file.close()  # removed or replaced between opening and locking
        return None
    return file


def _line(entry: Mapping[str, Any]) -> bytes:
    return json.dumps(entry, separators=(",", ":"), ensure_ascii=False).encode() + b"\n"
