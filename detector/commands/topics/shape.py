"""The shape of plain values: the fields of maps, the items of lists, and the kinds of values in them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from wayside.rules import Fields, ItemFields

_FIELDS = 500
"""Maximum number of names in a map: one with more is a table, not a message."""
_DEPTH = 12


class MessageShape:
    """The values at one place in messages."""

    def __init__(self) -> None:
        self.kinds: set[str] = set()
        """`number`, `boolean`, `text`, `bytes`, `list`, `map`, `null`."""
        self.fields: dict[str, MessageShape] = {}
        self.items: MessageShape | None = None

    def add(self, value: Any, depth: int = 0) -> None:
        """Add one more value."""
        kind = _kind(value)
        self.kinds.add(kind)
        if depth >= _DEPTH:
            return
        if kind == "map":
            for name, child in value.items():
                known = self.fields.get(name)
                if known is None:
                    if len(self.fields) >= _FIELDS:
                        continue
                    known = self.fields[name] = MessageShape()
                known.add(child, depth + 1)
        elif kind == "list" and value:
            self.items = self.items or MessageShape()
            for child in (value[0], value[-1]):
                self.items.add(child, depth + 1)

    def join(self, other: MessageShape) -> None:
        """Merge another shape into this one."""
        self.kinds |= other.kinds
        for name, child in other.fields.items():
            self.fields.setdefault(name, MessageShape()).join(child)
        if other.items is not None:
            self.items = self.items or MessageShape()
            self.items.join(other.items)

    @property
    def known_fields(self) -> Fields | None:
        """The fields for checking paths; None if values are neither maps nor lists of maps, or have too many names."""
        if self.items is not None and self.kinds <= {"list", "null"}:
            known = self.items.known_fields
            return None if known is None or isinstance(known, ItemFields) else ItemFields(known)
        if "map" not in self.kinds or not self.kinds <= {"map", "null"} or len(self.fields) >= _FIELDS:
            return None
        return {name: child.known_fields for name, child in self.fields.items()}

    def paths(self, above: str = "msg") -> Iterator[tuple[str, str]]:
        """Each place with its kinds, in the notation of expressions."""
        for name, child in self.fields.items():
            yield from child.paths(f"{above}.{name}" if name.isidentifier() else f'{above}["{name}"]')
        if self.items is not None and self.items.fields:
            yield from self.items.paths(f"{above}[0]")
        elif not self.fields:
            of = f" of {' or '.join(sorted(self.items.kinds))}" if self.items is not None else ""
            yield above, " or ".join(sorted(self.kinds)) + of


def message_paths(fields: Fields | None, above: str = "msg", depth: int = 0) -> Iterator[tuple[str, str]]:
    """The places of a message of a known type."""
    if not fields or depth >= _DEPTH:
        yield above, ""
        return
    if isinstance(fields, ItemFields):
        above = f"{above}[0]"
    for name, child in fields.items():
        yield from message_paths(child, f"{above}.{name}", depth + 1)


def _kind(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, int | float):
        return "number"
    if isinstance(value, str):
        return "text"
    if isinstance(value, bytes | bytearray):
        return "bytes"
    return "map" if isinstance(value, Mapping) else "list"
