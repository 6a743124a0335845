"""What was mined before: a file for each recording and run, in the dataset's folder.

Files have no state but their content, and come under their names when they are whole. So processes of several machines
may write into one folder, and one that is killed leaves nothing that is half.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from detector.mining.sources import InputRecording, RecordingPreview
from detector.mining.work import Mined, decode_mined


class CacheEntry(msgspec.Struct):
    """What a job came to."""

    keys: dict[str, str]
    """By rule, its key (see `keys`)."""
    mined: bytes
    """As `work.mine_recording` gave it."""
    clips: str | None = None
    """The name of its folder of clips."""
    failed: bool = False
    """Whether the next run tries again."""


class Cache:
    """The entries of one dataset."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError where the folder cannot be made."""
        self._folder = folder
        self._entries = folder / "mined"
        self._entries.mkdir(parents=True, exist_ok=True)
        self._seen: dict[str, tuple[str, RecordingPreview]] = self._read_seen()

    def put(self, content: str, entry: CacheEntry) -> None:
        """Keep what a job came to. Raises OSError."""
        name = f"{content}-{job_digest(entry.keys)}"
        if entry.failed:
            name += ".failed"
        elif (failed := self._entries / f"{name}.failed").exists():
            failed.unlink()
        _write(self._entries / name, msgspec.msgpack.encode(entry))

    def entries(self) -> dict[str, list[Path]]:
        """The files of entries by the content of their recordings."""
        found: dict[str, list[Path]] = {}
        for path in sorted(self._entries.iterdir()):
            if not path.name.startswith("."):
                found.setdefault(path.name.partition("-")[0], []).append(path)
        return found

    # What recordings are known by

    def seen(self, source: InputRecording, stamp: str | None) -> RecordingPreview | None:
        """What an earlier look at the recording showed, where its files are as they were."""
        before = self._seen.get("\0".join(source.files))
        return before[1] if before is not None and before[0] == stamp else None

    def note_seen(self, looks: Iterable[tuple[InputRecording, str | None, RecordingPreview]]) -> None:
        """Keep what looks showed. Raises OSError."""
        new = {"\0".join(source.files): (stamp, seen) for source, stamp, seen in looks if stamp is not None}
        if new:
            self._seen = {**self._read_seen(), **new}
            _write(self._folder / "seen.json", msgspec.json.encode(self._seen))

    def _read_seen(self) -> dict[str, tuple[str, RecordingPreview]]:
        try:
            data = (self._folder / "seen.json").read_bytes()
            return msgspec.json.decode(data, type=dict[str, tuple[str, RecordingPreview]])
        except (FileNotFoundError, msgspec.DecodeError):
            return {}


def job_digest(keys: Mapping[str, str]) -> str:
    """Stands for the rules of a job."""
    return hashlib.blake2b("".join(sorted(keys.values())).encode(), digest_size=8).hexdigest()


def read_entry(path: Path) -> CacheEntry | None:
    """The entry; None where another version wrote it. Raises OSError."""
    try:
        return msgspec.msgpack.decode(path.read_bytes(), type=CacheEntry)
    except msgspec.DecodeError:
        return None


def mined_in(entry: CacheEntry) -> Mined:
    """What the entry holds."""
    return decode_mined(entry.mined)


def _write(path: Path, data: bytes) -> None:
    """Under its name when it is whole."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_bytes(data)
    partial.replace(path)
