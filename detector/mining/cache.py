"""The cached results of mining: a file for each recording and run, in the dataset's folder.

Files are renamed to their final names when they are complete. Several machines may therefore write into one folder, and
a killed process leaves no partial file.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from detector.mining.sources import InputRecording, RecordingPreview
from detector.mining.work import RecordingResult, decode_mined
from wayside.process.files import replace_file


class CacheEntry(msgspec.Struct):
    """The result of a job."""

    keys: dict[str, str]
    """By rule, its key (see `keys`)."""
    mined: bytes
    """The output of `work.mine_recording`."""
    clips: str | None = None
    """The name of its folder of clips."""
    failed: bool = False
    """Whether the next run retries it."""


class Cache:
    """The entries of one dataset."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError if the folder cannot be created."""
        self._folder = folder
        self._entries = folder / "mined"
        self._entries.mkdir(parents=True, exist_ok=True)
        self._previews: dict[str, tuple[str, RecordingPreview]] = self._read_previews()

    def put(self, content: str, entry: CacheEntry) -> None:
        """Store the result of a job. Raises OSError."""
        name = f"{content}-{job_digest(entry.keys)}"
        if entry.failed:
            name += ".failed"
        elif (failed := self._entries / f"{name}.failed").exists():
            failed.unlink()
        _write(self._entries / name, msgspec.msgpack.encode(entry))

    def entries(self) -> dict[str, list[Path]]:
        """The files of entries, by the content of their recordings."""
        found: dict[str, list[Path]] = {}
        for path in sorted(self._entries.iterdir()):
            if not path.name.startswith("."):
                found.setdefault(path.name.partition("-")[0], []).append(path)
        return found

    # The identities of recordings

    def preview(self, source: InputRecording, stamp: str | None) -> RecordingPreview | None:
        """The cached preview of the recording, if its files are unchanged."""
        before = self._previews.get("\0".join(source.files))
        return before[1] if before is not None and before[0] == stamp else None

    def store_previews(self, previews: Iterable[tuple[InputRecording, str | None, RecordingPreview]]) -> None:
        """Store previews. Raises OSError."""
        new = {"\0".join(source.files): (stamp, seen) for source, stamp, seen in previews if stamp is not None}
        if new:
            self._previews = {**self._read_previews(), **new}
            _write(self._folder / "seen.json", msgspec.json.encode(self._previews))

    def _read_previews(self) -> dict[str, tuple[str, RecordingPreview]]:
        try:
            data = (self._folder / "seen.json").read_bytes()
            return msgspec.json.decode(data, type=dict[str, tuple[str, RecordingPreview]])
        except (FileNotFoundError, msgspec.DecodeError):
            return {}


def job_digest(keys: Mapping[str, str]) -> str:
    """Identifies the rules of a job."""
    return hashlib.blake2b("".join(sorted(keys.values())).encode(), digest_size=8).hexdigest()


def read_entry(path: Path) -> CacheEntry | None:
    """The entry; None if another version wrote it. Raises OSError."""
    try:
        return msgspec.msgpack.decode(path.read_bytes(), type=CacheEntry)
    except msgspec.DecodeError:
        return None


def mined_in(entry: CacheEntry) -> RecordingResult:
    """The contents of the entry."""
    return decode_mined(entry.mined)


def _write(path: Path, data: bytes) -> None:
    replace_file(path, data, draft=path.with_name(f".{path.name}.{os.getpid()}"))
