"""The folder of all recordings: its disk space, and the deletion of old recordings.

There is one object per folder in a process, shared by all actions. Bytes are claimed before they are written, so the
limits hold at any time over all recordings in progress; complete recordings are found in the folder itself. A recording
in progress has a hidden name, and is never dropped.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from detector.actions.record.description import DESCRIPTION, FORMAT
from wayside.api.recordings import Recordings, WhenFull

PARTIAL = ".partial"
"""The suffix of the hidden folder of a recording in progress."""
DROPPED = ".dropped"
"""The suffix of the hidden folder of a recording that is being deleted."""

_SCAN_SECONDS = 2.0
"""Minimum seconds between two scans of a full folder."""


class NoRoomError(Exception):
    """There is no room for a recording; the text names the limit and the remedy."""


@dataclass(frozen=True, slots=True, order=True)
class FinishedRecording:
    """A complete recording under its final name."""

    ended: float
    """Seconds since the epoch."""
    path: Path
    bytes: int
    files: int


class Destination:
    """The disk space for recordings in one folder. Thread-safe."""

    def __init__(self, limits: Recordings) -> None:
        """Raises OSError if the folder cannot be created or read."""
        self.path = Path(limits.path)
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock = threading.Lock()
        self._limits = limits
        self._bytes = self._files = 0
        self._ahead = 0
        self._left = [*hidden(self.path, PARTIAL)]
        self._scan()

    def take_unfinished(self) -> list[Path]:
        """The hidden folders that existed before this process recorded here; empty from the second call on."""
        with self._lock:
            left, self._left = self._left, []
            return left

    def limit(self, limits: Recordings) -> None:
        """Use these limits from now on."""
        with self._lock:
            self._limits = limits

    @property
    def used(self) -> int:
        """Bytes of all recordings, including the claims of those in progress."""
        with self._lock:
            return self._total

    def claim(self, now: int, later: int, files: int = 0, *, forced: bool = False) -> list[FinishedRecording]:
        """Reserve room for the bytes that are written now, and for those that complete the recording later.

        Negative numbers release room; `forced` ignores the limits. Returns the recordings that were dropped for it.
        Raises NoRoomError, OSError.
        """
        with self._lock:
            needed = now + later
            dropped: list[FinishedRecording] = []
            while not forced and (needed > 0 or files > 0) and (short := self._short(needed, files)):
                if time.monotonic() - self._scanned > _SCAN_SECONDS:  # files may have been deleted manually
                    self._scan()
                    continue
                if self._limits.when_full is WhenFull.STOP:
                    raise NoRoomError(f"{short}; whenFull is Stop: make room in {self.path}, or raise the limit")
                if not self._kept:
                    raise NoRoomError(f"{short}; no finished recording is left to delete: raise the limit")
                dropped.append(self._drop(self._kept[0]))
            self._bytes += needed
            self._files += files
            self._ahead += later
            return dropped

    def release(self, claimed: tuple[int, int, int], kept: FinishedRecording | None) -> None:
        """Release the claims of a recording that is no longer in progress; `kept` counts with its actual size."""
        now, later, files = claimed
        with self._lock:
            self._bytes -= now + later
            self._ahead -= later
            self._files -= files
            if kept is not None and all(each.path != kept.path for each in self._kept):
                self._keep([*self._kept, kept])

    def expire(self) -> list[FinishedRecording]:
        """Drops recordings that have exceeded their maximum age, and returns them. Raises OSError."""
        with self._lock:
            age = self._limits.age
            if age is None:
                return []
            self._scan()
            horizon = time.time() - age.seconds
            return [self._drop(each) for each in [*self._kept] if each.ended < horizon]

    @property
    def _total(self) -> int:
        return self._bytes + self._kept_bytes

    def _short(self, size: int, files: int) -> str:
        """The limit that this many more bytes would exceed; empty if none."""
        limits = self._limits
        if size > 0 and self._total + size > limits.bytes.bytes:
            return f"the recordings would use more than spec.recordings.bytes ({limits.bytes})"
        total = self._files + self._kept_files + files
        if files > 0 and limits.files is not None and total > limits.files:
            return f"there would be more than {limits.files} files (spec.recordings.files)"
        if size > 0 and self._free() - self._ahead - size < limits.reserve.bytes:
            return f"less than {limits.reserve} of the disk would be free (spec.recordings.reserve)"
        return ""

    def _free(self) -> int:
        stat = os.statvfs(self.path)
        return stat.f_bavail * stat.f_frsize

    def _drop(self, kept: FinishedRecording) -> FinishedRecording:
        """Delete a recording. It is hidden during the deletion, so a partial one never seems complete."""
        self._keep(each for each in self._kept if each is not kept)
        hidden = hidden_path(kept.path, DROPPED)
        try:
            kept.path.rename(hidden)
        except FileNotFoundError:
            return kept  # another process deleted it
        shutil.rmtree(hidden)
        return kept

    def _keep(self, recordings: Iterable[FinishedRecording]) -> None:
        self._kept = sorted(recordings)
        self._kept_bytes = sum(each.bytes for each in self._kept)
        self._kept_files = sum(each.files for each in self._kept)

    def _scan(self) -> None:
        self._keep(finished_recordings(self.path))
        self._scanned = time.monotonic()


def hidden_path(path: Path, ending: str) -> Path:
    """The hidden path of a recording with this final path."""
    return path.with_name(f".{path.name}{ending}")


def finished_recordings(path: Path) -> Iterator[FinishedRecording]:
    """The complete recordings in a folder. Other files are left alone."""
    for rule in _folders(path):
        for folder in _folders(rule):
            if not folder.name.startswith(".") and (kept := _kept(folder)) is not None:
                yield kept


def hidden(path: Path, ending: str) -> Iterator[Path]:
    """The folders of recordings that are in progress or being deleted."""
    for rule in _folders(path):
        yield from (each for each in _folders(rule) if each.name.startswith(".") and each.name.endswith(ending))


def _folders(path: Path) -> list[Path]:
    try:
        return [Path(each.path) for each in os.scandir(path) if each.is_dir(follow_symlinks=False)]
    except (FileNotFoundError, NotADirectoryError):
        return []


def _kept(folder: Path) -> FinishedRecording | None:
    description = folder / DESCRIPTION
    try:
        fields = json.loads(description.read_bytes())
        if not isinstance(fields, dict) or fields.get("format") != FORMAT:
            return None
        stats = {each.name: each.stat() for each in folder.iterdir()}
    except (OSError, ValueError):
        return None
    files = sum(name.endswith(".mcap") for name in stats)
    return FinishedRecording(stats[DESCRIPTION].st_mtime, folder, sum(stat.st_size for stat in stats.values()), files)


_PLACES: dict[str, Destination] = {}
_PLACES_LOCK = threading.Lock()


def destination(limits: Recordings) -> Destination:
    """The one object for that folder in this process, with these limits from now on. Raises OSError."""
    with _PLACES_LOCK:
        name = os.path.realpath(limits.path)
        place = _PLACES.get(name)
        if place is None:
            place = _PLACES[name] = Destination(limits)
        else:
            place.limit(limits)
            place.path.mkdir(parents=True, exist_ok=True)
        return place
