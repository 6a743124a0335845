"""rosbag2: a folder with metadata.yaml and files in MCAP or SQLite, or one SQLite file, read through rosbags.

Recordings of the record action are such folders that may contain JSON and other streams in addition to ROS topics.
rosbags skips those, so their MCAP files are read here. In a split recording each file begins with the last samples of
latched streams; such a message has its original number, and is used only once.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import apsw
from backports.zstd import ZstdError
from mcap.records import Channel
from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError

from detector.actions.record.description import DESCRIPTION, FORMAT
from detector.replay.batches import Batch, batched, merged_batches
from detector.replay.mcap_file import is_cut, mcap_types, read_mcap
from detector.replay.message import DAMAGE, Message, OnCut, RecordedType, RecordingError, Wanted, topic_key

SQLITE_MAGIC = b"SQLite format 3\0"

_DAMAGE = (*DAMAGE, ReaderError, apsw.Error, ZstdError)


def read_rosbag2(path: Path, wanted: Wanted, on_cut: OnCut) -> Iterator[Batch]:
    """The bag's messages in time order. Raises RecordingError if it is damaged or of an unknown kind.

    If the recorder of a bag with MCAP files was killed, each file is read up to its cut.
    """
    files = sorted(path.glob("*.mcap")) if path.is_dir() else []
    if any(is_cut(file) for file in files):
        return merged_batches([read_mcap(file, wanted, on_cut) for file in files])
    return batched(_messages(path, wanted))


def _messages(path: Path, wanted: Wanted) -> Iterator[Message]:
    try:
        with Reader(path) as reader:
            connections = [connection for connection in reader.connections if wanted(topic_key(connection.topic))]
            if not connections:  # rosbags would treat an empty list as all
                return
            for connection, time, payload in reader.messages(connections):
                extra = connection.ext
                encoding = extra.serialization_format if isinstance(extra, ConnectionExtRosbag2) else "cdr"
                yield Message(time, topic_key(connection.topic), bytes(payload), encoding, connection.msgtype)
    except _DAMAGE as error:
        raise _damaged(path, error) from error


def rosbag2_types(path: Path) -> list[RecordedType]:
    """The message types that the bag defines; older bags define none. Raises RecordingError if it is damaged."""
    files = sorted(path.glob("*.mcap")) if path.is_dir() else []
    if any(is_cut(file) for file in files):
        return list(dict.fromkeys(each for file in files for each in mcap_types(file)))
    try:
        with Reader(path) as reader:
            return [
                RecordedType(
                    connection.msgtype,
                    connection.msgdef.data,
                    connection.msgdef.format is MessageDefinitionFormat.IDL,
                )
                for connection in reader.connections
            ]
    except _DAMAGE as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> RecordingError:
    reason = str(error) or type(error).__name__
    files = sorted(file for kind in ("mcap", "db3") for file in path.glob(f"*.{kind}")) if path.is_dir() else [path]
    repairs = " and ".join(f"`{_repair(file)}`" for file in files)
    remedy = f"repair it with {repairs}" if repairs else "give the folder with its .mcap or .db3 files"
    return RecordingError(f"{path}: cannot read the rosbag2: it is damaged or of an unknown kind ({reason}): {remedy}")


def _repair(file: Path) -> str:
    return f"mcap recover {file}" if file.suffix == ".mcap" else f"sqlite3 {file} .recover"


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
