"""The compression of a recording's chunks. Other threads run during compression."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import lz4.frame
import zstandard

from wayside.api.actions.record import Compression

Pieces = Sequence[bytes | bytearray]
"""A chunk, not joined."""
Compress = Callable[[Pieces], tuple[str, Pieces]]
"""Compresses a chunk; also returns MCAP's name of the compression."""


def compressor(compression: Compression) -> Compress:
    """The function that compresses the chunks of one recording; for one thread."""
    match compression:
        case Compression.NONE:
            return lambda pieces: ("", pieces)
        case Compression.LZ4:
            return lambda pieces: ("lz4", (lz4.frame.compress(b"".join(pieces)),))
        case Compression.ZSTD:
            zstd = zstandard.ZstdCompressor(level=1)  # almost as fast as lz4, and much smaller
            return lambda pieces: ("zstd", (zstd.compress(b"".join(pieces)),))


def decompress(name: str, data: bytes, size: int) -> bytes:
    """The chunk of `size` bytes. Raises ValueError if it cannot be read."""
    try:
        match name:
            case "":
                return data
            case "lz4":
                return bytes(lz4.frame.decompress(data))
            case "zstd":
                return zstandard.decompress(data, max_output_size=size)
    except (RuntimeError, zstandard.ZstdError) as error:
        raise ValueError(str(error)) from error
    raise ValueError(f"unknown compression of recordings: {name!r}")
