"""Recordings of the record action: a rosbag2 that may contain JSON and other streams in addition to its ROS topics.

Other readers skip those, so its MCAP files are read here. In a split recording each file begins with the last samples
of latched streams; such a message has its original number, and is used only once.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.records import Channel

from detector.actions.record.description import DESCRIPTION, FORMAT
from detector.replay.batches import Batch
from detector.replay.errors import RecordingError
from detector.replay.mcap_file import mcap_types, read_mcap
from detector.replay.message import OnCut, RecordedType, Wanted


def is_own_recording(path: Path) -> bool:
    """Whether the folder was written by the record action."""
    try:
        metadata = json.loads((path / DESCRIPTION).read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(metadata, dict) and metadata.get("format") == FORMAT


def read_own_recording(path: Path, wanted: Wanted, on_cut: OnCut) -> Iterator[Batch]:
    """The messages, file by file, in time order. Raises RecordingError if a file has been altered."""
    taken: set[tuple[str, str, int]] = set()

    def repeated(channel: Channel) -> Callable[[int], bool] | None:
        if channel.metadata.get("latched") != "true":
            return None
        client = channel.metadata.get("client", "")

        def is_repeated(sequence: int) -> bool:
            about = channel.topic, client, sequence
            if about in taken:
                return True
            taken.add(about)
            return False

        return is_repeated

    for file in _files(path):
        yield from read_mcap(file, wanted, on_cut, repeated)


def own_recording_types(path: Path) -> list[RecordedType]:
    """The message types that the files define. Raises RecordingError."""
    return list(dict.fromkeys(each for file in _files(path) for each in mcap_types(file)))


def _files(path: Path) -> list[Path]:
    files = [path / name for name in json.loads((path / DESCRIPTION).read_bytes()).get("files", [])]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise RecordingError(
            f"{path}: {missing[0]} is missing, although {DESCRIPTION} lists it: copy all files of the recording"
        )
    return files
