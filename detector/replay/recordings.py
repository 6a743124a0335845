"""Recordings of any kind as one series of messages in time order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from detector.replay.batches import Batch, merged_batches
from detector.replay.json_lines import json_lines_span, read_json_lines
from detector.replay.mcap_file import MAGIC as MCAP_MAGIC
from detector.replay.mcap_file import mcap_span, mcap_types, read_mcap
from detector.replay.message import OnCut, RecordedType, RecordingError, Wanted, ignore
from detector.replay.pcap import MAGICS as PCAP_MAGICS
from detector.replay.pcap import read_pcap
from detector.replay.rosbag1 import ROSBAG1_MAGIC, read_rosbag1, rosbag1_span, rosbag1_types
from detector.replay.rosbag2 import (
    SQLITE_MAGIC,
    is_own_recording,
    own_recording_types,
    read_own_recording,
    read_rosbag2,
    rosbag2_types,
)

_Read = Callable[[Path, Wanted, OnCut], Iterator[Batch]]

_KINDS = "rosbag2 folders, ROS 1 bags, .mcap, .db3, .pcap, .pcapng and JSON lines"


def open_recordings(
    paths: Sequence[Path], wanted: Wanted = lambda key: True, on_cut: OnCut = ignore
) -> Iterator[Batch]:
    """The wanted messages of all recordings, merged by time; of equal times, those of the recording given first.

    The kinds are detected by the contents of the files. A truncated one is read up to its end, and `on_cut` is called.
    Raises RecordingError at once for one that is missing or of unknown kind, later if one turns out to be damaged.
    """
    readers = [(_reader(path), path) for path in paths]
    return merged_batches([read(path, wanted, on_cut) for read, path in readers])


def check_exists(path: Path) -> None:
    """Raises RecordingError if the recording is missing."""
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder")


_Span = Callable[[Path], tuple[int, int] | None]

_SPANS: dict[_Read, _Span] = {read_mcap: mcap_span, read_rosbag1: rosbag1_span}
"""By reader, the times of the first and the last message according to an index."""


def span_of(path: Path) -> tuple[int, int] | None:
    """The times of the first and the last message; None if there are no messages. Raises RecordingError."""
    read = _reader(path)
    span = _SPANS[read](path) if read in _SPANS else None
    if span is not None:
        return span
    first = last = None
    for batch in read(path, lambda key: True, ignore):
        first = batch.times[0] if first is None else first
        last = batch.times[-1]
    return None if first is None or last is None else (first, last)


def quick_span_of(paths: Sequence[Path]) -> tuple[int, int] | None:
    """The approximate times of the first and last message of one recording; None if only reading it all shows it."""
    quick = {**_SPANS, read_json_lines: json_lines_span}
    spans: list[tuple[int, int]] = []
    for path in paths:
        try:
            read = _reader(path)
            span = quick[read](path) if read in quick else None
        except (RecordingError, OSError):
            return None
        if span is None:
            return None
        spans.append(span)
    return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None


def types_of(path: Path) -> list[RecordedType]:
    """The ROS 2 message types that a recording defines. Raises RecordingError."""
    kinds: dict[_Read, Callable[[Path], list[RecordedType]]] = {
        read_mcap: mcap_types,
        read_rosbag1: rosbag1_types,
        read_rosbag2: rosbag2_types,
        read_own_recording: own_recording_types,
    }
    types = kinds.get(_reader(path))
    return [] if types is None else types(path)


def _reader(path: Path) -> _Read:
    check_exists(path)
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise RecordingError(f"{path}: a folder without metadata.yaml is not a rosbag2: give the recordings in it")
        return read_own_recording if is_own_recording(path) else read_rosbag2
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise RecordingError(f"{path}: cannot read it: {error.strerror}") from error
    if head.startswith(MCAP_MAGIC):
        return read_mcap
    if head.startswith(ROSBAG1_MAGIC):
        if path.suffix != ".bag":
            raise RecordingError(f"{path}: the name of a ROS 1 bag must end in .bag: rename it")
        return read_rosbag1
    if head.startswith(PCAP_MAGICS):
        return read_pcap
    if head.startswith(SQLITE_MAGIC):
        if path.suffix != ".db3":
            raise RecordingError(f"{path}: the name of an SQLite rosbag2 must end in .db3: rename it")
        return read_rosbag2
    if head.lstrip().startswith(b"{") or (not head and path.suffix in (".jsonl", ".ndjson")):
        return read_json_lines
    if not head:
        raise RecordingError(f"{path}: the file is empty")
    raise RecordingError(f"{path} is not a recording that Wayside can read; it reads {_KINDS}")
