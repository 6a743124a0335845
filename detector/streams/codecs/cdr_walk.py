"""CDR: generates the source that walks through messages of a type and reads the requested fields.

It follows rosbags' rules of alignment exactly, so it finds fields at the same positions.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from detector.streams.codecs.cdr_source import CdrSource, UnwalkableError
from detector.streams.codecs.cdr_values import PADDING, array, scalar
from detector.streams.codecs.paths import Path
from detector.streams.codecs.ros import RosTypes

Tree = Mapping[str, "Tree | bool"]
"""The requested fields of a message; True: the whole value."""

_FORMATS: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_OCTETS: Final = frozenset(("uint8", "char", "byte"))

_UNROLLED = 32
"""Arrays of up to this number of messages are unrolled, larger ones are read in a loop."""
_MOST_FIELDS = 20_000
"""Maximum number of fields in a generated function: deeply repeated messages would make it endless."""


@dataclass(frozen=True, slots=True)
class Value:
    """A value that the source has read, and its conversion to a plain value."""

    expression: str
    convert: Callable[[Any], Any] | None = None
    place: tuple[str, str] | None = None
    """The source of its first byte and of the byte behind it; None: it is no number or text."""
    form: str = ""
    """The format of a number; empty: it is none."""


@dataclass
class Walk:
    """Adds source that walks through messages. It refers to `texts`, which checks and reads texts."""

    types: RosTypes
    source: CdrSource
    found: dict[Path, Value] = field(default_factory=dict)
    """The requested values, by path."""
    fields: int = 0

    def message(self, type_name: str, wanted: Tree | bool, path: Path = ()) -> str:
        """Walks through a message; returns the source of its value if the whole message is requested."""
        parts: list[str] = []
        fields = self.types.fields(type_name)
        for place, (name, desc) in enumerate(fields):
            self.fields += 1
            if self.fields > _MOST_FIELDS:
                raise UnwalkableError(f"{type_name} has too many fields")
            if isinstance(wanted, bool):
                value = self._field(desc, wanted)
                if name != PADDING:
                    parts.append(f"{name!r}: {self._plain(value)}")
            else:
                below = name != PADDING and wanted.get(name, False)
                value = self._field(desc, below, (*path, name))
                if below is True:
                    self.found[*path, name] = value
            if place + 1 < len(fields):
                following = self._alignment(fields[place + 1][1])
                if self._alignment_behind(desc) < following:
                    self.source.align(following)
        return f"{{{', '.join(parts)}}}"

    def _plain(self, value: Value) -> str:
        """The source of the plain value."""
        convert = value.convert
        if convert is None:
            return value.expression
        return f"{self.source.bind(convert)}({value.expression})"

    def _field(self, desc: FieldDesc, wanted: Tree | bool, path: Path = ()) -> Value:
        """Walks through a field; its value is kept if the whole field is requested."""
        kind, detail = desc
        if kind is Nodetype.NAME:
            return Value(self.message(str(detail), wanted, path))
        whole = wanted is True
        if kind is Nodetype.BASE:
            return self._scalar(str(detail[0]), whole)
        element: FieldDesc = detail[0]  # type: ignore[assignment]
        count = int(detail[1])
        of_messages = element[0] is Nodetype.NAME
        if not of_messages and element[0] is not Nodetype.BASE:
            raise UnwalkableError("arrays of arrays")
        if kind is Nodetype.ARRAY:
            if count == 0:
                raise UnwalkableError("an array of nothing")  # rosbags' alignment depends on the surrounding fields
            if of_messages:
                return self._array_of_messages(str(element[1]), count, whole)
            return self._array(str(element[1][0]), count, whole)
        if of_messages:
            return self._sequence_of_messages(str(element[1]), whole)
        return self._sequence(str(element[1][0]), whole)

    def _scalar(self, kind: str, wanted: bool) -> Value:
        """A number or a text."""
        if kind == "string":
            return self._text(wanted)
        size = _size(kind)
        if wanted:
            form, place = _FORMATS[kind], (self.source.at(), self.source.at(size))
            # A byte is read as an octet directly.
            return Value(self.source.read(form, size), float if kind == "byte" else scalar(kind), place, form)
        self.source.advance(size)
        return Value("")

    def _text(self, wanted: bool) -> Value:
        length = self.source.length()
        self.source.flush()
        begin = self.source.at()
        self.source.rebase(f"{begin} + {length}", 1)
        text = f"texts[p[{begin}:{self.source.base}]]"
        if self.source.noting:
            self.source.line(f"spans.append(({begin}, {self.source.base}))")
        if not wanted:
            self.source.line(text)
            return Value("")
        name = self.source.name()
        self.source.line(f"{name} = {text}")
        return Value(name, place=(begin, self.source.base))

    def _array(self, kind: str, count: int, wanted: bool) -> Value:
        if kind == "string":
            values = self._collected(wanted)
            self._append(values, self._text(wanted).expression)
            if count > 1:
                with_values = partial(self._next_text, values)
                self.source.loop(str(count - 1), with_values)
            return Value(values or "")
        value = self._numbers(kind, str(count), self.source.at()) if wanted else ""
        self.source.advance(count * _size(kind))
        return Value(value)

    def _sequence(self, kind: str, wanted: bool) -> Value:
        count = self.source.length()
        if kind == "string":
            values = self._collected(wanted)
            self.source.line(f"if {self.source.at()} + 5 * {count} > len(p): raise IndexError")
            self.source.loop(count, partial(self._next_text, values))
            return Value(values or "")
        size = _size(kind)
        begin = self.source.at()
        divisor = self.source.divisor()
        if size > 4 and divisor < size:
            begin = self.source.name()
            self.source.line(f"{begin} = (({self.source.at(3)}) & -8) + 4 if {count} else {self.source.at()}")
        self.source.flush()
        value = self._numbers(kind, count, begin) if wanted else ""
        self.source.rebase(f"{begin} + {count} * {size}", math.gcd(divisor, size))
        return Value(value)

    def _numbers(self, kind: str, count: str, begin: str) -> str:
        """Reads an array of numbers; returns the name of its value."""
        name = self.source.name()
        if kind in _OCTETS:
            self.source.line(f"{name} = p[{begin}:{begin} + {count}]")
            return name
        dtype = self.source.bind(np.dtype(self.source.sign + _FORMATS[kind]))
        convert = self.source.bind(array(kind))
        self.source.line(f"{name} = {convert}(frombuffer(p, {dtype}, {count}, {begin}))")
        return name

    def _next_text(self, values: str | None) -> None:
        self.source.align(4)
        self._append(values, self._text(values is not None).expression)

    def _array_of_messages(self, type_name: str, count: int, wanted: bool) -> Value:
        element: FieldDesc = (Nodetype.NAME, type_name)
        before = self._alignment(element)
        aligned = before > self._alignment_behind(element)

        def one(values: str | None) -> None:
            if aligned:
                self.source.align(before)
            self._append(values, self.message(type_name, wanted))

        values = self._collected(wanted)
        if count <= _UNROLLED:
            for _ in range(count):
                one(values)
        else:
            self.source.loop(str(count), partial(one, values))
        return Value(values or "")

    def _sequence_of_messages(self, type_name: str, wanted: bool) -> Value:
        count = self.source.length()
        before = self._alignment((Nodetype.NAME, type_name))
        self.source.line(f"if {self.source.at()} + {count} > len(p): raise IndexError")
        size = None if wanted else self._fixed_size(type_name, before)
        if size is not None:
            divisor = math.gcd(self.source.divisor(), before, size)
            here = self.source.at()
            begin = (
                f"(({self.source.at(3)}) & -8) + 4" if before == 8 else f"(({self.source.at(before - 1)}) & -{before})"
            )
            stride = size + -size % before
            self.source.rebase(f"{begin} + {size} + {stride} * ({count} - 1) if {count} else {here}", divisor)
            return Value("")

        def one(values: str | None) -> None:
            self.source.align(before)
            self._append(values, self.message(type_name, wanted))

        values = self._collected(wanted)
        self.source.loop(count, partial(one, values))
        return Value(values or "")

    def _fixed_size(self, type_name: str, alignment: int) -> int | None:
        """The size of messages of the type if it is constant for this alignment; else None."""
        source = CdrSource(self.source.sign, modulus=alignment)
        alone = Walk(self.types, source, fields=self.fields)
        alone.message(type_name, False)
        self.fields = alone.fields
        return None if source.lines or source.pending else source.constant

    def _collected(self, wanted: bool) -> str | None:
        """A list for requested values."""
        if not wanted:
            return None
        name = self.source.name()
        self.source.line(f"{name} = []")
        return name

    def _append(self, values: str | None, value: str) -> None:
        if values is not None:
            self.source.line(f"{values}.append({value})")

    def _alignment(self, desc: FieldDesc) -> int:
        """rosbags' alignment of a field."""
        kind, detail = desc
        if kind is Nodetype.NAME:
            return self._alignment(self.types.fields(str(detail))[0][1])
        if kind is Nodetype.SEQUENCE:
            return 4
        if kind is Nodetype.ARRAY:
            return self._alignment(detail[0])  # type: ignore[arg-type]
        return 4 if detail[0] == "string" else _size(str(detail[0]))

    def _alignment_behind(self, desc: FieldDesc) -> int:
        """The alignment that rosbags assumes for the position after a field."""
        kind, detail = desc
        if kind is Nodetype.NAME:
            return self._alignment_behind(self.types.fields(str(detail))[-1][1])
        if kind is Nodetype.BASE:
            return 1 if detail[0] == "string" else _size(str(detail[0]))
        behind = self._alignment_behind(detail[0])  # type: ignore[arg-type]
        return min(4, behind) if kind is Nodetype.SEQUENCE else behind


def _size(kind: str) -> int:
    """The size of a number, in bytes."""
    if kind not in _FORMATS:
        raise UnwalkableError(f"{kind} is not supported")
    return struct.calcsize("<" + _FORMATS[kind])
