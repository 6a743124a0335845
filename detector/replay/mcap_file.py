"""MCAP files of any origin, read in the order of their log times, chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel as McapChannel
from mcap.records import Message as McapMessage
from mcap.records import Schema
from mcap.summary import Summary

from detector.replay.batches import Batch, Channel, batched
from detector.replay.mcap_chunks import Chunks, Left
from detector.replay.mcap_cut import MAGIC, ChunkLocation, UnindexedMcap, messages_at, scan_mcap
from detector.replay.message import (
    DAMAGE,
    Message,
    OnCut,
    Piece,
    RecordedType,
    RecordingError,
    Truncation,
    Wanted,
    messages_in_order,
    topic_key,
)
from detector.replay.protobuf import ENCODING as PROTOBUF
from detector.replay.protobuf import Decoders

__all__ = ["MAGIC", "Left", "is_cut", "mcap_chunks", "mcap_span", "mcap_types", "read_mcap"]

_DAMAGE = (*DAMAGE, McapError, zstandard.ZstdError)


class _Index(NamedTuple):
    """The reader of a file with an index, and the index."""

    reader: SeekingReader
    summary: Summary


def read_mcap(
    path: Path,
    wanted: Wanted,
    on_cut: OnCut,
    left: Left = lambda channel: None,
    between: tuple[int, int] | None = None,
) -> Iterator[Batch]:
    """The file's messages, in the order of their log times. A truncated file is read up to its end.

    `between`: only those from the first to the second time, both included; for files that `mcap_chunks` knows.

    Raises RecordingError if it is damaged, or contains Protobuf messages that cannot be read.
    """
    protobuf = Decoders(path)

    def described(schema: Schema | None, channel: McapChannel) -> Channel:
        return Channel(
            topic_key(channel.topic),
            channel.message_encoding,
            _type(schema.name) if schema is not None and channel.message_encoding == "cdr" else None,
            protobuf.decoder(schema, channel.topic) if channel.message_encoding == PROTOBUF else None,
        )

    with path.open("rb") as file:
        try:
            index = _index(file)
            if index is None:
                yield from batched(_without_index(path, file, wanted, on_cut, left, described))
                return
            summary = index.summary
            topics = {channel.topic for channel in summary.channels.values() if wanted(topic_key(channel.topic))}
            if not topics:
                return
            if summary.chunk_indexes:

                def of_summary(channel: McapChannel) -> Channel:
                    return described(summary.schemas[channel.schema_id] if channel.schema_id else None, channel)

                yield from Chunks(file, summary, of_summary, wanted, left, between).batches()
                return
            kept = _Kept(left)
            yield from batched(
                _message(described(schema, channel), message)
                for schema, channel, message in index.reader.iter_messages(topics)
                if kept(channel, message)
            )
        except RecordingError:
            raise
        except _DAMAGE as error:
            raise _damaged(path, error) from error


class _Kept:
    """Whether a message is not left out."""

    def __init__(self, left: Left) -> None:
        self._left = left
        self._filters: dict[int, Callable[[int], bool] | None] = {}

    def __call__(self, channel: McapChannel, message: McapMessage) -> bool:
        if channel.id not in self._filters:
            self._filters[channel.id] = self._left(channel)
        leaves_out = self._filters[channel.id]
        return leaves_out is None or not leaves_out(message.sequence)


def _message(channel: Channel, message: McapMessage) -> Message:
    return Message(message.log_time, channel.key, message.data, channel.encoding, channel.type, channel.decode)


def _without_index(
    path: Path,
    file: BinaryIO,
    wanted: Wanted,
    on_cut: OnCut,
    left: Left,
    described: Callable[[Schema | None, McapChannel], Channel],
) -> Iterator[Message]:
    contents = scan_mcap(file)
    kept = _Kept(left)

    def messages(place: ChunkLocation) -> Iterator[Message]:
        try:
            for message in messages_at(file, place, contents):
                channel = contents.channels[message.channel_id]
                if wanted(topic_key(channel.topic)) and kept(channel, message):
                    yield _message(described(contents.schemas.get(channel.schema_id), channel), message)
        except _DAMAGE:
            if contents.cut is None or place is not contents.places[-1]:
                raise  # otherwise it is the last part that the recorder wrote

    if contents.places != sorted(contents.places):
        _define_all(file, contents)  # a channel's first chunk in the file is not the first in time
    count = 0
    for message in messages_in_order(Piece(place[0], partial(messages, place)) for place in contents.places):
        count += 1
        yield message
    if contents.cut is not None:
        on_cut(Truncation(path, count, contents.cut))


def mcap_types(path: Path) -> list[RecordedType]:
    """The ROS 2 message types that the file defines. Raises RecordingError if it is damaged."""
    with path.open("rb") as file:
        try:
            index = _index(file)
            schemas = _define_all(file, scan_mcap(file)) if index is None else index.summary.schemas
            return [
                RecordedType(_type(schema.name), schema.data.decode(errors="replace"), schema.encoding == "ros2idl")
                for schema in schemas.values()
                if schema.encoding in ("ros2msg", "ros2idl")
            ]
        except _DAMAGE as error:
            raise _damaged(path, error) from error


def mcap_span(path: Path) -> tuple[int, int] | None:
    """The first and the last log time in the file's index; None if it has none. Raises RecordingError if damaged."""
    with path.open("rb") as file:
        try:
            index = _index(file)
        except _DAMAGE as error:
            raise _damaged(path, error) from error
        statistics = None if index is None else index.summary.statistics
        if statistics is None or not statistics.message_count:
            return None
        return statistics.message_start_time, statistics.message_end_time


def mcap_chunks(path: Path) -> list[tuple[int, int]] | None:
    """By chunk, its first time and its size in bytes, by time; None if the file has no index of chunks."""
    try:
        with path.open("rb") as file:
            index = _index(file)
    except (*_DAMAGE, OSError):
        return None
    if index is None or not index.summary.chunk_indexes:
        return None
    return sorted((each.message_start_time, each.uncompressed_size) for each in index.summary.chunk_indexes)


def is_cut(path: Path) -> bool:
    """Whether the file is truncated."""
    with path.open("rb") as file:
        return not _is_whole(file)


def _is_whole(file: BinaryIO) -> bool:
    """Whether the file has the end of an MCAP file."""
    file.seek(0, 2)
    size = file.tell()
    file.seek(max(0, size - len(MAGIC)))
    return size >= 2 * len(MAGIC) and file.read() == MAGIC


def _define_all(file: BinaryIO, contents: UnindexedMcap) -> dict[int, Schema]:
    """Reads the schemas and channels in chunks as well; returns the schemas."""
    for place in contents.places:
        try:
            for _ in messages_at(file, place, contents):
                pass
        except _DAMAGE:
            if contents.cut is None or place is not contents.places[-1]:
                raise
    return contents.schemas


def _index(file: BinaryIO) -> _Index | None:
    """The file's index; None if it has none, because it was truncated or written without one."""
    if not _is_whole(file):
        return None
    file.seek(0)
    reader = SeekingReader(file, validate_crcs=True, record_size_limit=1 << 30)
    summary = reader.get_summary()
    return None if summary is None else _Index(reader, summary)


def _damaged(path: Path, error: Exception) -> RecordingError:
    reason = str(error) or type(error).__name__
    return RecordingError(f"{path}: the MCAP file is damaged ({reason}): repair it with `mcap recover {path}`")


def _type(schema: str) -> str:
    """The type with its folder: some writers leave out the msg."""
    package, _, name = schema.partition("/")
    return schema if "/" in name or not name else f"{package}/msg/{name}"
