"""The folder of a recording in progress: hidden and locked, until it is renamed atomically to its final name.

The lock distinguishes a recording in progress from one that a killed process left behind.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from detector.actions.record.description import DESCRIPTION, BagFile, as_text, metadata_yaml
from detector.actions.record.destination import PARTIAL, Destination, FinishedRecording, hidden_path
from wayside.process.files import replace_file, sync_folder

CUT = "_cut"
"""The suffix of the names of incomplete recordings."""
_ROOM = ".room"
"""A file that reserves disk space for completing the recording."""
_ROOM_BYTES = 64 * 1024

Dropped = Callable[[Sequence[FinishedRecording]], None]
"""Receives the recordings that were deleted to make room."""


class RecordingFolder:
    """A hidden folder, locked by this process. Tracks its claims on the destination."""

    def __init__(
        self, destination: Destination, path: Path, name: str, dropped: Dropped, *, forced: bool = False
    ) -> None:
        """Locks the folder. `forced`: all its claims succeed.

        Raises BlockingIOError if another process has locked it, and other OSErrors.
        """
        self.path = path
        self.name = name
        """Its final name, without the suffix for how it ended."""
        self._destination = destination
        self._dropped = dropped
        self._forced = forced
        self._claimed = (0, 0, 0)
        self._lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise

    @classmethod
    def create(cls, destination: Destination, rule: str, name: str, dropped: Dropped) -> RecordingFolder:
        """Create a new one. A number is appended to the name if it exists already. Raises NoRoomError, OSError."""
        parent = destination.path / rule
        parent.mkdir(exist_ok=True)
        number, chosen = 1, name
        while any((parent / f"{chosen}{end}").exists() for end in ("", CUT)) or not _made(parent / chosen):
            number += 1
            chosen = f"{name}_{number}"
        folder = cls(destination, hidden_path(parent / chosen, PARTIAL), chosen, dropped)
        try:
            folder.claim(_ROOM_BYTES, 0)
            _keep_room(folder.path / _ROOM)
        except BaseException:
            folder.remove()
            raise
        return folder

    def claim(self, now: int, later: int, files: int = 0) -> None:
        """See Destination.claim. Raises NoRoomError, OSError."""
        gone = self._destination.claim(now, later, files, forced=self._forced)
        before = self._claimed
        self._claimed = before[0] + now, before[1] + later, before[2] + files
        if gone:
            self._dropped(gone)

    def use_room(self) -> None:
        """Releases the reserved disk space: call it before the recording is completed. Raises OSError."""
        room = self.path / _ROOM
        if room.exists():
            room.unlink()
            self.claim(-_ROOM_BYTES, 0)

    def describe(self, fields: Mapping[str, Any]) -> None:
        """Writes the description. Raises OSError."""
        replace_file(self.path / DESCRIPTION, json.dumps(fields, ensure_ascii=False, indent=1), durable=True)

    def described(self) -> dict[str, Any] | None:
        """The existing description; None if there is none that can be read."""
        try:
            fields = json.loads((self.path / DESCRIPTION).read_bytes())
        except (OSError, ValueError):
            return None
        return fields if isinstance(fields, dict) else None

    def publish(self, parts: Sequence[BagFile], fields: Mapping[str, Any]) -> FinishedRecording:
        """Renames the folder to its final name, after syncing it to disk. Raises OSError: then it is unchanged."""
        replace_file(self.path / "metadata.yaml", metadata_yaml(parts, as_text(fields)), durable=True)
        self.describe(fields)
        os.fsync(self._lock)
        final = self.path.with_name(self.name + (CUT if "cut" in fields else ""))
        self.path.rename(final)
        sync_folder(final.parent)
        size = sum(each.stat().st_size for each in final.iterdir())
        kept = FinishedRecording(time.time(), final, size, len(parts))
        self._release(kept)
        return kept

    def remove(self) -> None:
        """Remove the folder, because nothing in it is worth keeping. Raises OSError."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._release(None)

    def leave(self) -> None:
        """Leave it for the next start of the detector; its room stays claimed."""
        os.close(self._lock)

    def _release(self, kept: FinishedRecording | None) -> None:
        self._destination.release(self._claimed, kept)
        os.close(self._lock)


def _made(final: Path) -> bool:
    try:
        hidden_path(final, PARTIAL).mkdir()
    except FileExistsError:
        return False
    return True


def _keep_room(path: Path) -> None:
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        os.posix_fallocate(fd, 0, _ROOM_BYTES)
    finally:
        os.close(fd)
