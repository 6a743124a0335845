"""Recovers the recordings of a killed process: at the next start they are completed, marked as cut, and renamed.

Of an incomplete MCAP file the intact part counts (`salvage`).
"""

from __future__ import annotations

import io
import logging
import os
import shutil
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Header, Metadata, MetadataIndex, Schema

from detector.actions.record.description import METADATA_CUT, METADATA_END, BagFile, ending, with_ending
from detector.actions.record.destination import DROPPED, PARTIAL, Destination, FinishedRecording, hidden
from detector.actions.record.folder import RecordingFolder
from detector.actions.record.mcap_file import (
    LIBRARY,
    MAGIC,
    Claim,
    Contents,
    McapFile,
    compressor,
    decompress,
    packed_message_indexes,
    write_at,
)
from wayside.api.actions.record import Compression

log = logging.getLogger(__name__)

REASON = "the detector was killed while it recorded"
"""The reason that such recordings are marked with."""


def recover(destination: Destination, left: Iterable[Path]) -> list[FinishedRecording]:
    """Completes the recordings in these hidden folders; one that another process has locked is in progress and left
    alone.

    Recordings that cannot be completed are left unchanged, and logged.
    """
    for path in hidden(destination.path, DROPPED):
        shutil.rmtree(path, ignore_errors=True)
    kept = []
    for path in left:
        try:
            recording = _recovered(destination, path)
        except BlockingIOError:
            continue
        except OSError as error:
            log.error("%s: cannot complete the interrupted recording: %s", path, error)
            continue
        if recording is not None:
            log.warning("%s: %s; completed the recording with the data that was written", recording.path, REASON)
            kept.append(recording)
    return kept


def _recovered(destination: Destination, path: Path) -> FinishedRecording | None:
    name = path.name.removeprefix(".").removesuffix(PARTIAL)
    folder = RecordingFolder(destination, path, name, lambda dropped: None, forced=True)
    files = sorted(path.glob("*.mcap"), key=lambda each: int(each.stem.rpartition("_")[2]))
    folder.claim(sum(each.stat().st_size for each in path.iterdir()), 0, len(files))
    folder.use_room()
    fields = folder.described()
    try:
        last = files[-1:]
        found = () if fields is None else ((_part(file, folder, fields, file in last)) for file in files)
        parts = [part for part in found if part is not None]
        samples = sum(part.contents.messages for part in parts)
        if fields is None or not samples:
            folder.remove()
            return None
        return folder.publish(
            parts, with_ending(fields, cut=REASON, samples=samples, files=[part.name for part in parts])
        )
    except OSError:
        folder.leave()
        raise


def _part(path: Path, folder: RecordingFolder, fields: dict[str, Any], last: bool) -> BagFile | None:
    """The completed file; None if nothing in it can be read: it is deleted.

    The last file is checked even if it seems complete: the disk may not have received all of it.
    """
    contents = None if last else contents_of(path)
    if contents is None:
        file = salvage(path, folder.claim)
        if file is None or not file.contents.messages:
            if file is not None:
                file.give_up()
            path.unlink()
            return None
        try:
            file.add_metadata(METADATA_CUT, {"reason": REASON})
            file.add_metadata(METADATA_END, ending(with_ending(fields, cut=REASON, samples=file.contents.messages)))
            file.finish()
        finally:
            file.give_up()
        contents = file.contents
    return BagFile(path.name, contents)


_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQ")
_UNREADABLE = (EOFError, McapError, UnicodeDecodeError, ValueError, struct.error, KeyError)


def contents_of(path: Path) -> Contents | None:
    """The contents of a complete file; None if it was not completed. Raises OSError."""
    with path.open("rb") as file:
        try:
            summary = SeekingReader(file).get_summary()
        except (*_UNREADABLE, OSError):
            return None
        if summary is None or summary.statistics is None:
            return None
        counts = dict(summary.statistics.channel_message_counts)
        return Contents(dict(summary.schemas), dict(summary.channels), list(summary.chunk_indexes), [counts], [])


def salvage(path: Path, claim: Claim) -> McapFile | None:
    """The file, ready to be completed after its last intact chunk; None if not even its header is intact.

    Raises OSError.
    """
    fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        with open(fd, "rb", closefd=False) as file:
            size = os.fstat(fd).st_size
            reader = _Salvage(file, size)
            if not reader.head():
                os.close(fd)
                return None
            while reader.step():
                pass
        os.ftruncate(fd, reader.end)
        write_at(fd, [reader.missing_index], reader.end)
    except BaseException:
        os.close(fd)
        raise
    end = reader.end + len(reader.missing_index)
    return McapFile(path, compressor(Compression.NONE), claim, fd, reader.contents, end)


class _Salvage:
    """Reads a file record by record, up to the first one that is not intact."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self._size = size
        self.contents = Contents()
        self.end = 0
        """Up to here the file is intact."""
        self.missing_index = b""
        """The missing part of the last chunk's index after that."""

    def head(self) -> bool:
        """Whether it begins like a recording."""
        if self._file.read(len(MAGIC)) != MAGIC:
            return False
        self.end = len(MAGIC)
        try:
            opcode, data = self._record()
            return opcode == Opcode.HEADER and Header.read(_stream(data)).library == LIBRARY
        except _UNREADABLE:
            return False

    def step(self) -> bool:
        """Read the next record; False at the end of the intact part, or of the data."""
        at = self.end
        try:
            opcode, data = self._record()
            match opcode:
                case Opcode.SCHEMA:
                    schema = Schema.read(_stream(data))
                    self.contents.schemas[schema.id] = schema
                case Opcode.CHANNEL:
                    channel = Channel.read(_stream(data))
                    self.contents.channels[channel.id] = channel
                case Opcode.METADATA:
                    name = Metadata.read(_stream(data)).name
                    if name in (METADATA_CUT, METADATA_END):
                        raise EOFError
                    self.contents.metadata.append(MetadataIndex(offset=at, length=self.end - at, name=name))
                case Opcode.CHUNK:
                    return self._chunk(at, Chunk.read(_stream(data)))
                case _:
                    raise EOFError
        except _UNREADABLE:
            self.end = at
            return False
        return True

    def _chunk(self, at: int, chunk: Chunk) -> bool:
        data = decompress(chunk.compression, chunk.data, chunk.uncompressed_size)
        if zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("the chunk's checksum is wrong")
        messages = _messages(data)
        offsets, indexes = packed_message_indexes(messages, self.end)
        self.contents.chunks.append(
            ChunkIndex(
                chunk_length=self.end - at,
                chunk_start_offset=at,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self.contents.counts.append({channel: len(pairs) // 2 for channel, pairs in messages.items()})
        if self._file.read(len(indexes)) == indexes:
            self.end += len(indexes)
            return True
        self.missing_index = indexes
        return False

    def _record(self) -> tuple[int, bytes]:
        """The next intact record. Raises EOFError if there is none."""
        head = self._file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise EOFError
        opcode, length = _RECORD.unpack(head)
        if self.end + _RECORD.size + length > self._size:
            raise EOFError
        data = self._file.read(length)
        self.end += _RECORD.size + length
        return opcode, data


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _messages(data: bytes) -> dict[int, list[int]]:
    """By channel in a chunk, the log times and offsets of its messages. Raises struct.error, ValueError."""
    messages: dict[int, list[int]] = defaultdict(list)
    at = 0
    while at < len(data):
        opcode, length, channel, _, log_time = _MESSAGE.unpack_from(data, at)
        if opcode != Opcode.MESSAGE:
            raise ValueError("a chunk of a recording may contain messages only")
        messages[channel] += (log_time, at)
        at += _RECORD.size + length
    return messages
