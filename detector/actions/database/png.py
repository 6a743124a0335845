"""ROS images as PNG, without loss.

Sources: sensor_msgs/image_encodings.hpp for the meaning of the encodings, RFC 2083 for PNG.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

_GRAY, _RGB, _RGBA = 0, 2, 6


class _Pixel(NamedTuple):
    octets: int
    """Bytes per channel."""
    channels: tuple[int, ...]
    """The order of the message's channels in the PNG."""
    colour: int
    """PNG's colour type."""


_ENCODINGS = {
    **{name: _Pixel(1, (0,), _GRAY) for name in ("mono8", "8UC1")},
    **{name: _Pixel(2, (0,), _GRAY) for name in ("mono16", "16UC1")},
    **{f"bayer_{order}8": _Pixel(1, (0,), _GRAY) for order in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{order}16": _Pixel(2, (0,), _GRAY) for order in ("rggb", "bggr", "gbrg", "grbg")},
    "rgb8": _Pixel(1, (0, 1, 2), _RGB),
    "bgr8": _Pixel(1, (2, 1, 0), _RGB),
    "rgba8": _Pixel(1, (0, 1, 2, 3), _RGBA),
    "bgra8": _Pixel(1, (2, 1, 0, 3), _RGBA),
    "rgb16": _Pixel(2, (0, 1, 2), _RGB),
    "bgr16": _Pixel(2, (2, 1, 0), _RGB),
}


def png(image: Mapping[str, Any]) -> bytes | None:
    """A sensor_msgs/msg/Image as PNG; None if PNG has no such pixels (e.g. 32FC1), or if the sizes do not fit."""
    pixel = _ENCODINGS.get(image["encoding"])
    width, height, step = int(image["width"]), int(image["height"]), int(image["step"])
    data = image["data"]
    if pixel is None or not width or not height:
        return None
    row = width * pixel.octets * len(pixel.channels)
    if step < row or len(data) < step * height:
        return None
    order = ">" if image.get("is_bigendian") else "<"
    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(f"{order}u{pixel.octets}").reshape(height, width, len(pixel.channels))
    pixels = pixels[:, :, list(pixel.channels)].astype(f">u{pixel.octets}")
    lines = np.zeros((height, 1 + row), np.uint8)  # each line begins with its filter type: none
    lines[:, 1:] = pixels.reshape(height, -1).view(np.uint8)
    header = struct.pack(">IIBBBBB", width, height, 8 * pixel.octets, pixel.colour, 0, 0, 0)
    compressed = zlib.compress(lines.tobytes(), 1)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", compressed) + _chunk(b"IEND", b"")


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
