"""The contents of an MCAP file as described by its summary: enough to complete a new or truncated file."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "wayside recording 1"
"""The library in the header; the number is the version of the recording's contents."""

_INDEX_HEAD = struct.Struct("<BQHI")

ChunkMessages = Mapping[int, list[int]]
"""By channel of a chunk: the log time of a message (nanoseconds), its offset in the chunk, those of the next …"""


def packed(record: McapRecord) -> bytes:
    """The record in its binary form."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def packed_message_indexes(messages: ChunkMessages, at: int) -> tuple[dict[int, int], bytes]:
    """The message indexes that follow a chunk, at that offset of the file, and the offset of each channel's index."""
    offsets: dict[int, int] = {}
    data = bytearray()
    for channel, pairs in messages.items():
        offsets[channel] = at + len(data)
        data += _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(pairs), channel, 8 * len(pairs))
        data += struct.pack(f"<{len(pairs)}Q", *pairs)
    return offsets, bytes(data)


@dataclass(slots=True)
class Contents:
    """Schemas, channels, chunks and metadata of a file, in the order of the file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    counts: list[Mapping[int, int]] = field(default_factory=list)
    """By chunk, the number of messages of each channel."""
    metadata: list[MetadataIndex] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """Number of messages in the chunks."""
        return sum(sum(counts.values()) for counts in self.counts)

    @property
    def by_channel(self) -> Mapping[int, int]:
        """Number of messages of each channel in the chunks."""
        total: Counter[int] = Counter()
        for counts in self.counts:
            total.update(counts)
        return total

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last log time; zeros if there are no messages."""
        if not self.chunks:
            return 0, 0
        return (
            min(chunk.message_start_time for chunk in self.chunks),
            max(chunk.message_end_time for chunk in self.chunks),
        )

    def summary(self, start: int) -> bytes:
        """Everything that follows the end of the data, which is at offset `start`."""
        first, last = self.span
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.by_channel),
            chunk_count=len(self.chunks),
            message_count=self.messages,
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )
        data = bytearray()
        offsets = bytearray()
        groups: tuple[tuple[Opcode, Iterable[McapRecord]], ...] = (
            (Opcode.SCHEMA, self.schemas.values()),
            (Opcode.CHANNEL, self.channels.values()),
            (Opcode.STATISTICS, (statistics,)),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.METADATA_INDEX, self.metadata),
        )
        for opcode, records in groups:
            begin = len(data)
            for record in records:
                data += packed(record)
            if len(data) > begin:
                offset = SummaryOffset(group_opcode=opcode, group_start=start + begin, group_length=len(data) - begin)
                offsets += packed(offset)
        offset_start = start + len(data)
        data += offsets
        checksum = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start), zlib.crc32(data))
        data += packed(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=checksum))
        return bytes(data + MAGIC)
