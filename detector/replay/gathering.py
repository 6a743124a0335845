"""The files of a command's arguments, and which of them form one recording.

Folders stand for the recordings in them, patterns such as `drives/*.mcap` for the matching files. Files form one
recording if the metadata.yaml of their rosbag2 folder names them, or if a recorder split it: then their names differ by
a consecutive number, and each begins where the previous one ends. The order of the arguments does not matter.
"""

from __future__ import annotations

import glob
import itertools
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from detector.actions.record.description import DESCRIPTION
from detector.replay.intake_file import is_intake_file
from detector.replay.message import RecordingError
from detector.replay.recordings import check_exists, span_of

Recording = tuple[Path, ...]
"""The files of one recording; or one rosbag2 folder."""

_SPLIT = 10 * 10**9
"""Nanoseconds: a recorder opens its next file within this time."""

_OVERLAP = 10**9
"""Nanoseconds: messages in transit when a file was closed may be in the next one."""

_DATE = re.compile(r"\d{4}(?:[-_]\d\d){5}|\d{14}")
_NUMBERED = re.compile(r"(.*?)(\d+)([_.-]*)")
TEXT = (".jsonl", ".ndjson")
BINARY = (".mcap", ".bag", ".db3", ".pcap", ".pcapng")
"""The suffixes of the names of recordings."""


def recordings_of(given: Sequence[Path], *, as_one: bool = False) -> list[Recording]:
    """The given recordings, in that order; as_one: all of them as one.

    A file that is damaged or of unknown kind counts as a separate recording, and raises an error when it is played.
    Raises RecordingError for missing files, and for folders and patterns without any recording.
    """
    paths = recording_paths(given)
    for path in paths:
        check_exists(path)
    return [tuple(paths)] if as_one else list(_joined(paths))


def intake_file_of(given: Sequence[Path]) -> Path | None:
    """The intake file, if one is given. Raises RecordingError if other recordings are given as well."""
    paths = recording_paths(given)
    found = next(filter(_is_intake_file, paths), None)
    if found is not None and len(paths) > 1:
        raise RecordingError(f"{found} is an intake file: replay it alone")
    return found


def recording_name(recording: Recording) -> str:
    """The name for users, and for the events of several recordings."""
    first = os.fsencode(recording[0]).decode(errors="replace")
    return first if len(recording) == 1 else f"{first} and {len(recording) - 1} more"


def recording_paths(given: Iterable[Path]) -> list[Path]:
    """Files and rosbag2 folders: folders and patterns are replaced by their contents. Each path once."""
    found = [path for each in given for path in _expanded(each)]
    return list({path.resolve(): path for path in found}.values())


def _expanded(path: Path) -> Iterator[Path]:
    if not path.exists() and glob.has_magic(str(path)):
        matching = sorted((Path(each) for each in glob.glob(str(path), recursive=True)), key=_natural)
        if not matching:
            raise RecordingError(f"{path}: no file matches: correct the pattern")
        for each in matching:
            yield from _expanded(each) if not each.is_dir() or _is_bag(each) or list(_inside(each)) else ()
    elif path.is_dir() and not _is_bag(path):
        inside = list(_inside(path))
        if not inside:
            kinds = ", ".join((*BINARY, *TEXT))
            raise RecordingError(f"{path}: the folder contains no recording: give one with {kinds} or rosbag2 folders")
        yield from inside
    else:
        yield path


def _inside(folder: Path) -> Iterator[Path]:
    """The recordings in a folder and its subfolders, by name; hidden files and other files are skipped."""
    for path in sorted(folder.iterdir(), key=_natural):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            yield from (path,) if _is_bag(path) else _inside(path)
        elif path.suffix in (*BINARY, *TEXT):
            yield path


def _is_intake_file(path: Path) -> bool:
    try:
        return path.exists() and is_intake_file(path)
    except OSError:
        return False  # the reader reports the reason


def _is_bag(folder: Path) -> bool:
    return (folder / "metadata.yaml").is_file() or (folder / DESCRIPTION).is_file()


def _natural(path: Path) -> list[tuple[int, str]]:
    """The name with numbers compared by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", str(path))]


def _joined(paths: Sequence[Path]) -> Iterator[Recording]:
    """The recordings, in order of their first files."""
    left = list(paths)
    while left:
        recording = _of_one_bag(left) or _split(left)
        left = [path for path in left if path not in recording]
        yield recording


def _of_one_bag(paths: Sequence[Path]) -> Recording | None:
    """The files of the rosbag2 folder that the first path belongs to; the folder itself if all its files are given."""
    first = paths[0]
    named = [] if first.is_dir() else _named_files(first.parent)
    if first.name not in named:
        return None
    return tuple(sorted((path for path in paths if path.parent == first.parent and path.name in named), key=_natural))


def _named_files(folder: Path) -> list[str]:
    """The files that a folder's metadata.yaml names."""
    try:
        metadata = yaml.safe_load((folder / "metadata.yaml").read_text(encoding="utf-8"))
        return [Path(each).name for each in metadata["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (OSError, ValueError, TypeError, LookupError, yaml.YAMLError):
        return []


def _split(paths: Sequence[Path]) -> Recording:
    """The first path, with the adjacent files of its recorder, in order of their numbers."""
    numbered: dict[_Place, list[Path]] = {}
    for path in paths:
        if (place := _place(path)) is not None:
            numbered.setdefault(place, []).append(path)
    place = _place(paths[0])
    if place is None:
        return (paths[0],)
    recording = [paths[0]]
    for number in itertools.count(place.number + 1):
        others = numbered.get(place._replace(number=number), ())
        following = next((other for other in others if _continues(recording[-1], other)), None)
        if following is None:
            break
        recording.append(following)
    for number in range(place.number - 1, -1, -1):
        others = numbered.get(place._replace(number=number), ())
        previous = next((other for other in others if _continues(other, recording[0])), None)
        if previous is None:
            break
        recording.insert(0, previous)
    return tuple(recording)


class _Place(NamedTuple):
    """A file's position in a series of files."""

    folder: Path
    before: str
    """The part of the name before the number."""
    behind: str
    number: int


def _place(path: Path) -> _Place | None:
    """The series of a file by its name, and its number there; None without a number. Dates do not count."""
    found = None if path.is_dir() else _NUMBERED.fullmatch(_DATE.sub("", path.stem))
    return None if found is None else _Place(path.parent, found[1], found[3] + path.suffix, int(found[2]))


def _continues(one: Path, other: Path) -> bool:
    """Whether the second file begins where the first one ends. An unreadable file is a separate recording."""
    try:
        first, second = span_of(one), span_of(other)
    except RecordingError:
        return False
    return first is not None and second is not None and -_OVERLAP <= second[0] - first[1] <= _SPLIT
