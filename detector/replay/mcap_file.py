"""MCAP files of any origin, read in the order of their log times, chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader

from detector.replay.errors import DAMAGE, RecordingError
from detector.replay.message import Message, Wanted, key_of

MAGIC = b"\x89MCAP0\r\n"

_DAMAGE = (*DAMAGE, McapError, zstandard.ZstdError)


def read_mcap(path: Path, wanted: Wanted) -> Iterator[Message]:
    """The file's messages, in the order of their log times. Raises RecordingError if it is cut or damaged."""
    with path.open("rb") as file:
        try:
            reader = SeekingReader(file, validate_crcs=True, record_size_limit=1 << 30)
            summary = reader.get_summary()
            if summary is None:
                raise McapError("it has no summary")
            topics = {channel.topic for channel in summary.channels.values() if wanted(key_of(channel.topic))}
            if not topics:
                return
            for schema, channel, message in reader.iter_messages(topics):
                yield Message(
                    message.log_time,
                    key_of(channel.topic),
                    message.data,
                    channel.message_encoding,
                    _type(schema.name) if schema is not None and channel.message_encoding == "cdr" else None,
                )
        except _DAMAGE as error:
            reason = str(error) or type(error).__name__
            raise RecordingError(
                f"{path}: the MCAP file is cut or damaged ({reason}): repair it with `mcap recover {path}`"
            ) from error


def _type(schema: str) -> str:
    """The type with its folder: some writers leave out the msg."""
    package, _, name = schema.partition("/")
    return schema if "/" in name or not name else f"{package}/msg/{name}"
