"""MCAP files of any origin, read in the order of their log times, chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel
from mcap.records import Message as McapMessage
from mcap.summary import Summary

from detector.replay.errors import DAMAGE, RecordingError
from detector.replay.message import Message, RecordedType, Wanted, key_of

MAGIC = b"\x89MCAP0\r\n"

_DAMAGE = (*DAMAGE, McapError, zstandard.ZstdError)


Left = Callable[[Channel, McapMessage], bool]
"""Whether a message is to be passed over."""


def read_mcap(path: Path, wanted: Wanted, left: Left = lambda channel, message: False) -> Iterator[Message]:
    """The file's messages, in the order of their log times. Raises RecordingError if it is cut or damaged."""
    with path.open("rb") as file:
        try:
            reader, summary = _opened(file)
            topics = {channel.topic for channel in summary.channels.values() if wanted(key_of(channel.topic))}
            if not topics:
                return
            for schema, channel, message in reader.iter_messages(topics):
                if left(channel, message):
                    continue
                yield Message(
                    message.log_time,
                    key_of(channel.topic),
                    message.data,
                    channel.message_encoding,
                    _type(schema.name) if schema is not None and channel.message_encoding == "cdr" else None,
                )
        except _DAMAGE as error:
            raise _damaged(path, error) from error


def mcap_types(path: Path) -> list[RecordedType]:
    """The ROS 2 message types that the file defines. Raises RecordingError if it is cut or damaged."""
    with path.open("rb") as file:
        try:
            _, summary = _opened(file)
            return [
                RecordedType(_type(schema.name), schema.data.decode(errors="replace"), schema.encoding == "ros2idl")
                for schema in summary.schemas.values()
                if schema.encoding in ("ros2msg", "ros2idl")
            ]
        except _DAMAGE as error:
            raise _damaged(path, error) from error


def _opened(file: BinaryIO) -> tuple[SeekingReader, Summary]:
    reader = SeekingReader(file, validate_crcs=True, record_size_limit=1 << 30)
    summary = reader.get_summary()
    if summary is None:
        raise McapError("it has no summary")
    return reader, summary


def _damaged(path: Path, error: Exception) -> RecordingError:
    reason = str(error) or type(error).__name__
    return RecordingError(f"{path}: the MCAP file is cut or damaged ({reason}): repair it with `mcap recover {path}`")


def _type(schema: str) -> str:
    """The type with its folder: some writers leave out the msg."""
    package, _, name = schema.partition("/")
    return schema if "/" in name or not name else f"{package}/msg/{name}"
