"""Moves large binary fields out of a message into files: images as PNG, point clouds as PCD, others unchanged.

Sources: sensor_msgs/image_encodings.hpp and RFC 2083 for images; sensor_msgs/msg/PointField and the Point Cloud
Library's description of PCD (binary, version 0.7) for point clouds.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wayside.process.files import replace_file

_IMAGE = {"height", "width", "encoding", "step", "data"}
_CLOUD = {"height", "width", "fields", "point_step", "row_step", "data"}
_COMPRESSED = (("jpeg", "jpg"), ("jpg", "jpg"), ("png", "png"), ("webp", "webp"))


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file that a document refers to."""

    path: str
    """Below the folder for files."""
    content: bytes

    def reference(self) -> dict[str, Any]:
        """The reference in the document in place of the content."""
        return {
            "file": self.path,
            "format": self.path.rpartition(".")[2].upper(),
            "bytes": len(self.content),
            "sha256": hashlib.sha256(self.content).hexdigest(),
        }


def detach(message: Any, above: int, place: str) -> tuple[Any, list[Attachment]]:
    """The message with references in place of its binary fields of more than `above` bytes, and the files.

    `place` is the beginning of the files' paths.
    """
    files: list[Attachment] = []

    def keep(content: bytes, suffix: str) -> dict[str, Any]:
        number = f"-{len(files)}" if files else ""
        files.append(Attachment(f"{place}{number}.{suffix}", content))
        return files[-1].reference()

    def large(value: Any) -> bool:
        return isinstance(value, bytes) and len(value) > above

    def walk(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {
                name: keep(*_form(value, name, each)) if large(each) else walk(each) for name, each in value.items()
            }
        if isinstance(value, list) and value and not isinstance(value[0], float | int | str):
            return [keep(each, "bin") if large(each) else walk(each) for each in value]
        return value

    if isinstance(message, bytes):  # of a raw stream
        return (keep(message, "bin") if large(message) else message), files
    return walk(message), files


def _form(around: Mapping[str, Any], name: str, content: bytes) -> tuple[bytes, str]:
    """The content of the field's file, and its suffix."""
    if name == "data":
        try:
            if around.keys() >= _IMAGE and (image := png(around)) is not None:
                return image, "png"
            if around.keys() >= _CLOUD and (cloud := pcd(around)) is not None:
                return cloud, "pcd"
        except (TypeError, ValueError, KeyError):  # looks like one, but is not
            return content, "bin"
        encoding = str(around.get("format", "")).lower()
        for word, suffix in _COMPRESSED:
            if word in encoding:
                return content, suffix
    return content, "bin"


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


_TYPES = {1: ("I", 1), 2: ("U", 1), 3: ("I", 2), 4: ("U", 2), 5: ("I", 4), 6: ("U", 4), 7: ("F", 4), 8: ("F", 8)}
"""PCD's type and size in bytes, by the datatype of a PointField."""


def pcd(cloud: Mapping[str, Any]) -> bytes | None:
    """A sensor_msgs/msg/PointCloud2 as PCD; None if its fields overlap or do not fit into its data.

    Bytes between the fields become fields named `_`, so that the points stay as they were sent. Spaces in the names of
    fields are replaced by `_`.
    """
    width, height = int(cloud["width"]), int(cloud["height"])
    step, row, data = int(cloud["point_step"]), int(cloud["row_step"]), cloud["data"]
    if not step or row < width * step or len(data) < row * height:
        return None
    columns: list[tuple[str, str, int, int]] = []
    swaps: list[tuple[int, int, int]] = []
    reached = 0
    for field in sorted(cloud["fields"], key=lambda each: float(each["offset"])):
        known = _TYPES.get(int(field["datatype"]))
        offset, count = int(field["offset"]), int(field["count"]) or 1
        if known is None or offset < reached:
            return None
        if offset > reached:
            columns.append(("_", "U", 1, offset - reached))
        columns.append(("_".join(field["name"].split()) or "_", *known, count))
        swaps.append((offset, known[1], count))
        reached = offset + known[1] * count
    if reached > step or not columns:
        return None
    if reached < step:
        columns.append(("_", "U", 1, step - reached))
    points = np.frombuffer(data, np.uint8, row * height).reshape(height, row)[:, : width * step].reshape(-1, step)
    if cloud.get("is_bigendian"):
        points = points.copy()
        for offset, size, count in swaps:
            part = slice(offset, offset + size * count)
            points[:, part] = points[:, part].reshape(-1, count, size)[:, :, ::-1].reshape(-1, size * count)
    header = "\n".join(
        (
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            "FIELDS " + " ".join(name for name, _, _, _ in columns),
            "SIZE " + " ".join(str(size) for _, _, size, _ in columns),
            "TYPE " + " ".join(kind for _, kind, _, _ in columns),
            "COUNT " + " ".join(str(count) for _, _, _, count in columns),
            f"WIDTH {width}",
            f"HEIGHT {height}",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {width * height}",
            "DATA binary\n",
        )
    )
    return header.encode("utf-8", "replace") + points.tobytes()


class FolderError(Exception):
    """A file could not be written; the message gives the reason."""


class AttachmentFolder:
    """Stores attachments, up to a number of bytes. A file appears only when it is complete and on disk."""

    def __init__(self, path: Path, capacity: int | None) -> None:
        self.path = path
        self._capacity = capacity
        self._used = 0 if capacity is None else _size(path)

    def write(self, attachment: Attachment) -> None:
        """Write it, unless the same file exists. Raises FolderError."""
        target = self.path / attachment.path
        if self._capacity is not None and self._used + len(attachment.content) > self._capacity:
            raise FolderError(f"the folder for files is full ({self._capacity} bytes)")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            replace_file(target, attachment.content, durable=True)
        except OSError as error:
            raise FolderError(f"cannot write a file: {error.strerror or type(error).__name__}") from None
        self._used += len(attachment.content)


def _size(path: Path) -> int:
    total = 0
    for folder, _, names in os.walk(path):
        for name in names:
            try:
                total += (Path(folder) / name).stat().st_size
            except OSError:  # removed in the meantime
                continue
    return total
