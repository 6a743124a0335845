"""Compiles ASN.1 types to functions that read UPER (ITU-T X.691) into plain maps, lists, strings and doubles.

A function is built once per type. It also converts values: CHOICE → {name: value}, BIT STRING → list of names,
ENUMERATED → name, numbers as in `quantities`. Names of components have `_` for `-`, so that expressions can use them
after a dot. Absent components are not in the map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.etsi import asn1
from detector.streams.codecs.etsi.bits import Bits
from detector.streams.codecs.etsi.quantities import UNAVAILABLE, quantity
from wayside.rules import Fields

Read = Callable[[Bits], Any]
"""Reads a value at the current position of the bits."""

_FIRST_WITHOUT_BOUND = 65536
"""Lengths that may reach this value are sent as if unbounded (11.9.4)."""


def expression_name(name: str) -> str:
    """The name of a component in expressions."""
    return name.replace("-", "_")


class Readers:
    """Builds the reading functions, one per type."""

    def __init__(self) -> None:
        self._made: dict[int, tuple[asn1.Type, Read]] = {}
        """By identity; the type is kept so that its identity stays unique."""

    def reader(self, kind: asn1.Type) -> Read:
        """The function that reads values of the type."""
        made = self._made.get(id(kind))
        if made is None:
            made = self._made[id(kind)] = (kind, self._make(kind))
        return made[1]

    def _make(self, kind: asn1.Type) -> Read:
        match kind:
            case asn1.Boolean():
                return lambda bits: bits.read(1) == 1
            case asn1.Null():
                return lambda bits: True  # in a CHOICE its presence is its value; null would read as unknown
            case asn1.Integer():
                return _integer(kind)
            case asn1.Enumerated():
                return _enumerated(kind)
            case asn1.BitString():
                return _bit_string(kind)
            case asn1.OctetString():
                return self._octet_string(kind)
            case asn1.Text():
                return _text(kind)
            case asn1.SequenceOf():
                return self._sequence_of(kind)
            case asn1.Sequence():
                return self._sequence(kind)
            case asn1.Choice():
                return self._choice(kind)
            case asn1.Open():
                return Bits.blob
            case asn1.Unreadable(name):
                return _refusal(f"it contains the unsupported ASN.1 type {name}")

    def _octet_string(self, kind: asn1.OctetString) -> Read:
        octets = _counted(kind.size, Bits.octets, b"".join)
        if kind.containing is None:
            return octets
        inner = self.reader(kind.containing)
        return lambda bits: inner(Bits(octets(bits)))

    def _sequence_of(self, kind: asn1.SequenceOf) -> Read:
        element = self.reader(kind.element)

        def elements(bits: Bits, count: int) -> list[Any]:
            return [element(bits) for _ in range(bits.elements(count))]

        return _counted(kind.size, elements, lambda pieces: [item for piece in pieces for item in piece])

    def _sequence(self, kind: asn1.Sequence) -> Read:
        root = self._fields(kind.root)
        if kind.additions is None:
            return root
        additions = [self._addition(addition) for addition in kind.additions]

        def read(bits: Bits) -> dict[str, Any]:
            extended = bits.read(1)
            value: dict[str, Any] = root(bits)
            if not extended:
                return value
            count = bits.small_length()
            sent = bits.read(count)
            for index in range(count):
                if sent >> (count - 1 - index) & 1:
                    blob = bits.blob()  # the type of a later version of the definition is skipped
                    if index < len(additions):
                        value.update(additions[index](Bits(blob)))
            return value

        return read

    def _addition(self, addition: asn1.Field | asn1.Group) -> Read:
        if isinstance(addition, asn1.Group):
            return self._fields(addition.fields)
        name, read = expression_name(addition.name), self.reader(addition.type)
        return lambda bits: {name: read(bits)}

    def _fields(self, fields: tuple[asn1.Field, ...]) -> Read:
        """Reads components without an extension marker: which optional ones are present, then all present ones."""
        readers: list[tuple[str, Read, int, Any]] = []
        opens: list[tuple[str, str, dict[int, Read]]] = []
        optional = sum(field.optional for field in fields)
        left = optional
        for field in fields:
            mask = 0
            if field.optional:
                left -= 1
                mask = 1 << left
            name = expression_name(field.name)
            readers.append((name, self.reader(field.type), mask, _absent(field)))
            if isinstance(field.type, asn1.Open):
                table = {key: self.reader(inner) for key, inner in field.type.table.items()}
                opens.append((name, expression_name(field.type.selector), table))

        def read(bits: Bits) -> dict[str, Any]:
            sent = bits.read(optional)
            value: dict[str, Any] = {}
            for name, reader, mask, absent in readers:
                if not mask or sent & mask:
                    value[name] = reader(bits)
                elif absent is not None:
                    value[name] = absent
            for name, selector, table in opens:
                inner = table.get(value.get(selector))  # type: ignore[arg-type]  # a double finds its integer
                if inner is not None and name in value:
                    value[name] = inner(Bits(value[name]))
            return value

        return read

    def _choice(self, kind: asn1.Choice) -> Read:
        root = [(expression_name(name), self.reader(inner)) for name, inner in kind.root]
        width = (len(root) - 1).bit_length()
        additions = [(expression_name(name), self.reader(inner)) for name, inner in kind.additions or ()]
        extensible = kind.additions is not None

        def read(bits: Bits) -> dict[str, Any] | None:
            if extensible and bits.read(1):
                index = bits.small()
                inner = Bits(bits.blob())
                if index >= len(additions):
                    return {}  # an alternative of a later version of the definition
                name, reader = additions[index]
                return {name: reader(inner)}
            index = bits.read(width)
            if index >= len(root):
                raise DecodeError(f"a CHOICE with {len(root)} alternatives has no alternative {index}")
            name, reader = root[index]
            return {name: reader(bits)}

        return read


def _integer(kind: asn1.Integer) -> Read:
    plain = quantity(kind)
    if kind.low is None or (kind.high is None and kind.extensible):
        if kind.extensible:
            return lambda bits: plain((bits.read(1), bits.signed())[1])
        return lambda bits: plain(bits.signed())
    low, high = kind.low, kind.high
    if high is None:
        return lambda bits: plain(low + bits.unsigned())
    width, span = (high - low).bit_length(), high - low

    def read(bits: Bits) -> Any:
        offset = bits.read(width)
        if offset > span:
            raise DecodeError(f"{kind.name or 'a number'} must be between {low} and {high}; got {low + offset}")
        return plain(low + offset)

    if not kind.extensible:
        return read
    return lambda bits: plain(bits.signed()) if bits.read(1) else read(bits)


def _enumerated(kind: asn1.Enumerated) -> Read:
    root = [None if name in UNAVAILABLE else name for name in kind.root]
    additions = [None if name in UNAVAILABLE else name for name in kind.additions or ()]
    width = (len(root) - 1).bit_length()
    extensible = kind.additions is not None

    def read(bits: Bits) -> str | None:
        if extensible and bits.read(1):
            index = bits.small()
            return additions[index] if index < len(additions) else None  # None: of a later version of the definition
        index = bits.read(width)
        if index >= len(root):
            raise DecodeError(f"an ENUMERATED with {len(root)} values has no value {index}")
        return root[index]

    return read


def _bit_string(kind: asn1.BitString) -> Read:
    def piece(bits: Bits, count: int) -> list[bool]:
        # Through the digits: shifting a long number for each of its bits would take quadratic time.
        return [digit == "1" for digit in f"{bits.read(count):0{count}b}"] if count else []

    flags = _counted(kind.size, piece, lambda pieces: [flag for piece in pieces for flag in piece])
    if not kind.named:
        return flags
    named = kind.named
    return lambda bits: [named.get(index, str(index)) for index, flag in enumerate(flags(bits)) if flag]


def _text(kind: asn1.Text) -> Read:
    if kind.alphabet is None:
        octets = _counted(asn1.ANY_SIZE, Bits.octets, b"".join)  # X.691 30.6: its size has no effect on UTF8String
        return lambda bits: octets(bits).decode("utf-8", "replace")
    alphabet = kind.alphabet
    width = (len(alphabet) - 1).bit_length()
    identity = ord(alphabet[-1]) < 1 << width  # the characters are sent unchanged if that takes no more bits

    def characters(bits: Bits, count: int) -> str:
        codes = [bits.read(width) for _ in range(bits.elements(count))]
        if identity:
            return "".join(map(chr, codes))
        if codes and max(codes) >= len(alphabet):
            raise DecodeError(f"a character is not in the alphabet of {len(alphabet)} characters")
        return "".join(alphabet[code] for code in codes)

    return _counted(kind.size, characters, "".join)


def _counted(size: asn1.Size, take: Callable[[Bits, int], Any], join: Callable[[list[Any]], Any]) -> Read:
    """Reads a length as in `size`, then that number of items."""

    def unbounded(bits: Bits) -> Any:
        return join([take(bits, length) for length in bits.lengths()])

    low, high = size.low, size.high
    if high is None or high >= _FIRST_WITHOUT_BOUND:
        bounded: Read = unbounded
    else:
        span = high - low
        width = span.bit_length()

        def bounded(bits: Bits) -> Any:
            offset = bits.read(width)
            if offset > span:
                raise DecodeError(f"a length must be between {low} and {high}; got {low + offset}")
            return take(bits, low + offset)

    if not size.extensible:
        return bounded
    return lambda bits: unbounded(bits) if bits.read(1) else bounded(bits)


def _absent(field: asn1.Field) -> Any:
    """The value in expressions of an absent component: its default."""
    if isinstance(field.type, asn1.Integer) and isinstance(field.absent, int):
        return quantity(field.type)(field.absent)
    return field.absent


def _refusal(text: str) -> Read:
    def read(bits: Bits) -> Any:
        raise DecodeError(text)

    return read


_HEADER: Fields = dict.fromkeys(("protocolVersion", "messageId", "stationId"))


def message_members(definitions: Iterable[asn1.Type]) -> Fields:
    """The fields of a message that can have several versions."""
    members: dict[str, Fields | None] = {}
    for definition in definitions:
        members = {**_joined(members, _members(definition) or {})}
    return {**members, "header": _HEADER}


def _members(kind: asn1.Type) -> Fields | None:
    """The fields below a value of the type; None below numbers, texts, lists and unknown types."""
    match kind:
        case asn1.Sequence():
            parts = [*kind.root, *(kind.additions or ())]
            fields = [each for part in parts for each in (part.fields if isinstance(part, asn1.Group) else (part,))]
            return {expression_name(field.name): _members(field.type) for field in fields}
        case asn1.Choice():
            alternatives = [*kind.root, *(kind.additions or ())]
            return {expression_name(name): _members(inner) for name, inner in alternatives}
        case asn1.OctetString():
            return None if kind.containing is None else _members(kind.containing)
        case _:
            return None


def _joined(first: Fields, second: Fields) -> Fields:
    both = {**first, **second}
    for name in first.keys() & second.keys():
        one, other = first[name], second[name]
        both[name] = None if one is None or other is None else _joined(one, other)
    return both
