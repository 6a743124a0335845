"""ASN.1 types, independent of the tool that read the definitions: everything needed to read UPER, and nothing else.

Bounds are those visible to PER: `None` is unbounded. `name` is the type's name in its module ("" for an inline type);
it determines the units of numbers (see `quantities`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


class DefinitionError(ValueError):
    """ASN.1 definitions that cannot be used; the message gives the reason and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Boolean:
    """BOOLEAN."""


@dataclass(frozen=True, slots=True, eq=False)
class Null:
    """NULL."""


@dataclass(frozen=True, slots=True, eq=False)
class Integer:
    """INTEGER; `named` are its named numbers."""

    name: str
    low: int | None
    high: int | None
    extensible: bool
    named: Mapping[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class Enumerated:
    """ENUMERATED: the names in the order of their values; `additions` is None if it is not extensible."""

    root: tuple[str, ...]
    additions: tuple[str, ...] | None


@dataclass(frozen=True, slots=True, eq=False)
class Size:
    """Number of elements, octets, bits or characters; `extensible`: other numbers are possible and marked as such."""

    low: int
    high: int | None
    extensible: bool


ANY_SIZE = Size(0, None, extensible=False)


@dataclass(frozen=True, slots=True, eq=False)
class BitString:
    """BIT STRING; `named` has the names of bits by their positions."""

    size: Size
    named: Mapping[int, str]


@dataclass(frozen=True, slots=True, eq=False)
class OctetString:
    """OCTET STRING; `containing` is the type of its contents, if the definition gives it."""

    size: Size
    containing: Type | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Text:
    """A character string; `alphabet` are its characters in order, None for UTF8String."""

    size: Size
    alphabet: str | None


@dataclass(frozen=True, slots=True, eq=False)
class SequenceOf:
    """SEQUENCE OF, SET OF."""

    element: Type
    size: Size


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """A component of a SEQUENCE. `absent` is its value if it is not sent: an ASN.1 default, or None."""

    name: str
    type: Type
    optional: bool
    absent: Any = None


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """An extension addition group, `[[ … ]]`."""

    fields: tuple[Field, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """SEQUENCE; `additions` is None if it is not extensible."""

    name: str
    root: tuple[Field, ...]
    additions: tuple[Field | Group, ...] | None


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """CHOICE: the alternatives by their index; `additions` is None if it is not extensible."""

    root: tuple[tuple[str, Type], ...]
    additions: tuple[tuple[str, Type], ...] | None


@dataclass(frozen=True, slots=True, eq=False)
class Open:
    """An open type: `table` has the type for each value of the component `selector` beside it."""

    selector: str
    table: Mapping[int, Type]


@dataclass(frozen=True, slots=True, eq=False)
class Unreadable:
    """A type that no ITS message uses, such as REAL; a message that contains one cannot be read."""

    kind: str


Type = (
    Boolean
    | Null
    | Integer
    | Enumerated
    | BitString
    | OctetString
    | Text
    | SequenceOf
    | Sequence
    | Choice
    | Open
    | Unreadable
)
