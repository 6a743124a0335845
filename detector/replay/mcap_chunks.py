"""The chunks of an MCAP file that has an index, read in bulk and merged by time.

The message indexes after a chunk contain the offsets of its messages. They are checked against the chunk, byte by byte:
if they do not match (or are missing), the chunk is read record by record.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import breakup_chunk, get_chunk_data_stream
from mcap.summary import Summary
from numpy.typing import NDArray

from detector.replay.batches import MAXIMUM_BYTES, MAXIMUM_MESSAGES, Batch, Channel
from detector.replay.message import DAMAGE, Wanted, topic_key

Left = Callable[[McapChannel], Callable[[int], bool] | None]
"""For a channel, the function that returns whether the message with a sequence number is left out; None if none is.

The function is called once for each message of the channel, in time order.
"""

_RECORD = struct.Struct("<BQ")
_INDEX = struct.Struct("<BQHI")
"""The header of a message index: opcode, length of the record, channel, length of the entries."""
_ENTRY = 16
"""Bytes: a time and an offset."""

_BODY = 22
"""The bytes of a message's record before its payload."""
_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<u8"), ("publish", "<u8")]
)
"""The fields of a message's record before its payload."""
_CHANNELS = 1 << 16
_DEFINITIONS = {Opcode.SCHEMA.value: Schema.read, Opcode.CHANNEL.value: McapChannel.read}


_ROW = np.dtype(
    [("time", "u8"), ("channel", "u2"), ("sequence", "u4"), ("chunk", "i4"), ("begin", "i8"), ("end", "i8")]
)
"""A message: its payload is at `begin` to `end` in the data of `chunk`."""
_Rows = NDArray[np.void]
"""Rows of `_ROW`, in time order; equal times in the order of the file."""


class _Waiting(NamedTuple):
    """The remaining messages of a chunk."""

    offset: int
    """The chunk's offset in the file."""
    rows: _Rows
    data: bytes
    """The chunk, decompressed."""


class Chunks:
    """Reads the chunks of one file."""

    def __init__(
        self,
        file: BinaryIO,
        summary: Summary,
        described: Callable[[McapChannel], Channel],
        wanted: Wanted,
        left: Left,
        between: tuple[int, int] | None = None,
    ) -> None:
        """`described` returns the batch's properties of a channel; it is called at the first message of the channel.

        `between`: only messages from the first to the second time, both included.
        """
        self._between = between
        self._file = file
        self._size = file.seek(0, 2)
        self._summary = summary
        self._described = described
        self._known = np.zeros(_CHANNELS, np.bool_)
        self._wanted = np.zeros(_CHANNELS, np.bool_)
        self._filters: dict[int, Callable[[int], bool]] = {}
        for number, channel in summary.channels.items():
            self._known[number] = True
            self._wanted[number] = wanted(topic_key(channel.topic))
            leaves_out = left(channel)
            if leaves_out is not None:
                self._filters[number] = leaves_out
        self._channels = np.full(_CHANNELS, None, np.object_)
        self._has_come = np.zeros(_CHANNELS, np.bool_)

    def batches(self) -> Iterator[Batch]:
        """The wanted messages in time order; equal times in the order of the file.

        A chunk is read when its first time is reached: only overlapping chunks are in memory. Raises McapError,
        ValueError, LookupError and others if the file is damaged.
        """
        indexes = sorted(
            filter(self._is_wanted, self._summary.chunk_indexes),
            key=lambda index: (index.message_start_time, index.chunk_start_offset),
        )
        waiting: list[_Waiting] = []
        for index in indexes:
            due, waiting = _split(waiting, index)
            yield from self._cut_out(due)
            read = self._read(index)
            if len(read.rows):
                waiting.append(read)
        yield from self._cut_out(waiting)

    def _is_wanted(self, index: ChunkIndex) -> bool:
        """Whether the chunk may contain wanted messages; without message indexes this is unknown."""
        if self._between is not None:
            first, last = self._between
            if index.message_end_time < first or index.message_start_time > last:
                return False
        offsets = index.message_index_offsets
        return not offsets or any(self._wanted[self._summary.channels[number].id] for number in offsets)

    def _read(self, index: ChunkIndex) -> _Waiting:
        """The wanted messages of a chunk."""
        self._file.seek(index.chunk_start_offset + _RECORD.size)
        chunk = Chunk.read(ReadDataStream(self._file))
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(size)
        begins = self._begins(index, size)
        rows = None if begins is None else _located(data, begins)
        if rows is None:
            rows, data = _scanned(chunk)
        channels = rows["channel"]
        known = self._known[channels]
        if not known.all():
            raise KeyError(int(channels[known.argmin()]))
        kept = self._wanted[channels]
        if not kept.all():
            rows = rows[kept]
        times = rows["time"]
        if (times[1:] < times[:-1]).any():
            rows = rows[np.argsort(times, kind="stable")]
        if self._between is not None:
            begin, end = index.message_start_time, index.message_end_time
            if len(rows) and not begin <= rows["time"][0] <= rows["time"][-1] <= end:
                raise ValueError(
                    "the times of a chunk differ from those in its index"
                )  # its other messages would be missed
            first, last = self._between
            rows = rows[(rows["time"] >= first) & (rows["time"] <= last)]
        return _Waiting(index.chunk_start_offset, rows, data)

    def _begins(self, index: ChunkIndex, size: int) -> NDArray[np.uint64] | None:
        """The offsets of the messages in a chunk of `size` bytes, in order, from its message indexes, if any."""
        length = index.message_index_length
        begin = index.chunk_start_offset + index.chunk_length
        most = size + _INDEX.size * _CHANNELS  # each message is longer than its entry
        if not 0 < length <= most or begin + length > self._size:
            return None
        self._file.seek(begin)
        raw = self._file.read(length)
        entries, at = [], 0
        while at + _INDEX.size <= len(raw):
            opcode, _, _, there = _INDEX.unpack_from(raw, at)
            at += _INDEX.size
            if opcode != Opcode.MESSAGE_INDEX or there % _ENTRY or at + there > len(raw):
                return None
            entries.append(raw[at : at + there])
            at += there
        return np.sort(np.frombuffer(b"".join(entries), "<u8")[1::2])

    def _cut_out(self, waiting: Sequence[_Waiting]) -> Iterator[Batch]:
        """Batches from the waiting messages."""
        if not waiting:
            return
        rows, data = _together(waiting)
        sizes = np.cumsum(rows["end"] - rows["begin"])
        begin = 0
        while begin < len(rows):
            before = sizes[begin - 1] if begin else 0
            enough = int(np.searchsorted(sizes, before + MAXIMUM_BYTES)) + 1
            end = min(enough, begin + MAXIMUM_MESSAGES)
            batch = self._batch(rows[begin:end], data)
            if batch.times:
                yield batch
            begin = end

    def _batch(self, rows: _Rows, data: Sequence[bytes]) -> Batch:
        if self._filters:
            rows = rows[self._kept(rows)]
        channels = rows["channel"]
        for number in dict.fromkeys(channels[~self._has_come[channels]].tolist()):
            self._channels[number] = self._described(self._summary.channels[number])
            self._has_come[number] = True
        return Batch(rows["time"].tolist(), self._channels[channels].tolist(), _payloads(rows, data))

    def _kept(self, rows: _Rows) -> NDArray[np.bool_]:
        """Which messages are not left out."""
        pairs = zip(rows["channel"].tolist(), rows["sequence"].tolist(), strict=True)
        filters = self._filters
        return np.array([number not in filters or not filters[number](sequence) for number, sequence in pairs], bool)


def _payloads(rows: _Rows, data: Sequence[bytes]) -> list[bytes]:
    """The payloads of the rows."""
    begins, sizes = rows["begin"], rows["end"] - rows["begin"]
    if len(data) == 1 and len(rows) and sizes[0] and (sizes == sizes[0]).all():
        size = int(sizes[0])
        # A view of the payload at every byte: indexing it copies only the payloads.
        windows = np.ndarray((len(data[0]) - size + 1,), (np.void, size), data[0], strides=(1,))
        payloads: list[bytes] = windows[begins].tolist()
        return payloads
    places = zip(rows["chunk"].tolist(), begins.tolist(), rows["end"].tolist(), strict=True)
    return [data[chunk][begin:end] for chunk, begin, end in places]


def _split(waiting: Sequence[_Waiting], index: ChunkIndex) -> tuple[list[_Waiting], list[_Waiting]]:
    """The messages before a chunk begins, and the others. For equal times, the position in the file decides."""
    before, rest = [], []
    start = np.array([index.message_start_time], np.uint64)
    for each in waiting:
        lies_before = each.offset < index.chunk_start_offset
        cut = int(np.searchsorted(each.rows["time"], start, "right" if lies_before else "left")[0])
        if cut:
            before.append(each._replace(rows=each.rows[:cut]))
        if cut < len(each.rows):
            rest.append(each._replace(rows=each.rows[cut:]))
    return before, rest


def _together(waiting: Sequence[_Waiting]) -> tuple[_Rows, list[bytes]]:
    """The rows of chunks by time, then by position in the file; and the chunks' data."""
    if len(waiting) == 1:
        return waiting[0].rows, [waiting[0].data]
    parts = sorted(waiting, key=lambda each: each.offset)
    rows = np.concatenate([part.rows for part in parts])
    rows["chunk"] = np.repeat(np.arange(len(parts)), [len(part.rows) for part in parts])
    return rows[np.argsort(rows["time"], kind="stable")], [part.data for part in parts]


def _located(data: bytes, begins: NDArray[np.uint64]) -> _Rows | None:
    """The messages at these offsets; None unless these are all messages of the chunk, and complete.

    Args:
        data: the chunk, decompressed.
        begins: ascending, but untrusted.
    """
    last = len(data) - _HEAD.itemsize
    if not len(begins) or int(begins[-1]) > last:
        return None
    starts = begins.astype(np.int64)
    # A view of the header at every byte: indexing it copies only the headers.
    heads = np.ndarray((last + 1,), _HEAD, data, strides=(1,))[starts]
    lengths = heads["length"]
    if (heads["opcode"] != Opcode.MESSAGE).any() or (lengths < _BODY).any() or (lengths > len(data)).any():
        return None
    ends = starts + lengths.astype(np.int64) + _RECORD.size
    if not _fills(data, starts, ends):
        return None
    rows = np.zeros(len(starts), _ROW)
    for column in ("time", "channel", "sequence"):
        rows[column] = heads[column]
    rows["begin"] = starts + _HEAD.itemsize
    rows["end"] = ends
    return rows


def _fills(data: bytes, starts: NDArray[np.int64], ends: NDArray[np.int64]) -> bool:
    """Whether the bytes between messages are complete records of other kinds."""
    gap_begins = np.concatenate(([0], ends))
    gap_ends = np.concatenate((starts, [len(data)]))
    gaps = np.flatnonzero(gap_begins != gap_ends)
    return all(map(partial(_are_others, data), gap_begins[gaps].tolist(), gap_ends[gaps].tolist()))


def _are_others(data: bytes, begin: int, end: int) -> bool:
    """Whether these bytes are complete records, none of them a message."""
    at = begin
    while at + _RECORD.size <= end:
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if opcode == Opcode.MESSAGE or (opcode in _DEFINITIONS and not _is_definition(data, at, opcode, length)):
            return False
        at += length
    return at == end


def _is_definition(data: bytes, at: int, opcode: int, length: int) -> bool:
    """Whether a schema or channel can be read here and matches its declared length."""
    file = io.BytesIO(data)
    file.seek(at)
    stream = ReadDataStream(file)
    try:
        _DEFINITIONS[opcode](stream)
    except (*DAMAGE, McapError):
        return False
    return stream.count == length


def _scanned(chunk: Chunk) -> tuple[_Rows, bytes]:
    """The messages of a chunk and their payloads, read record by record. Raises McapError, ValueError and others."""
    messages = [record for record in breakup_chunk(chunk, validate_crc=True) if isinstance(record, Message)]
    rows = np.zeros(len(messages), _ROW)
    rows["time"] = [message.log_time for message in messages]
    rows["channel"] = [message.channel_id for message in messages]
    rows["sequence"] = [message.sequence for message in messages]
    rows["end"] = np.cumsum([len(message.data) for message in messages])
    rows["begin"][1:] = rows["end"][:-1]
    return rows, b"".join(message.data for message in messages)
