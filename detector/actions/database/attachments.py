"""Moves large binary fields out of a message: images as PNG, point clouds as PCD, others unchanged."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from detector.actions.database.pcd import pcd
from detector.actions.database.png import png

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
