"""The content of an MCAP file, as far as its summary describes it: enough to complete a file, newly written or found
cut.
"""

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
"""The library in the header; the number is the version of what a recording holds."""

_INDEX_HEAD = struct.Struct("<BQHI")

ChunkMessages = Mapping[int, list[int]]
"""Of each channel in a chunk: the log time of a message (nanoseconds), its place in the chunk, those of the next …"""


def packed(record: McapRecord) -> bytes:
    """The record as the file has it."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def packed_message_indexes(messages: ChunkMessages, at: int) -> tuple[dict[int, int], bytes]:
    """The message indexes that stand behind a chunk, at that offset of the file; and where that of each channel is."""
    offsets: dict[int, int] = {}
    data = bytearray()
    for channel, pairs in messages.items():
        offsets[channel] = at + len(data)
        data += _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(pairs), channel, 8 * len(pairs))
        data += struct.pack(f"<{len(pairs)}Q", *pairs)
    return offsets, bytes(data)


@dataclass(slots=True)
class Contents:
    """Schemas, channels, chunks and metadata of a file, in the order in which they stand there."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    counts: list[Mapping[int, int]] = field(default_factory=list)
    """Of each chunk: how many messages of each channel."""
    metadata: list[MetadataIndex] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """How many messages the chunks hold."""
        return sum(sum(counts.values()) for counts in self.counts)

    @property
    def by_channel(self) -> Mapping[int, int]:
        """How many messages of each channel the chunks hold."""
        total: Counter[int] = Counter()
        for counts in self.counts:
            total.update(counts)
        return total

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last log time; zeros without messages."""
        if not self.chunks:
            return 0, 0
        return (
            min(chunk.message_start_time for chunk in self.chunks),
            max(chunk.message_end_time for chunk in self.chunks),
        )

    def summary(self, start: int) -> bytes:
        """All that stands behind the data's end, which is at offset `start`."""
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
