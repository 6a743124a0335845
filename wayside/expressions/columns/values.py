"""The contents of a column: a double for each row, and a tag that defines the meaning of the double."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, cast, final

import numpy as np
from numpy.typing import NDArray

from wayside.expressions.cel import Value
from wayside.expressions.numbers import MAX_EXACT
from wayside.expressions.projection import integer
from wayside.expressions.unknown import UNKNOWN, Unknown

Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Objects = NDArray[np.object_]


class Tag(IntEnum):
    """The type of the value in a row."""

    ABSENT = 0
    """No value: missing, null, NaN or unknown."""
    NUMBER = 1
    BOOLEAN = 2
    TEXT = 3
    OTHER = 4
    """A list, a map, bytes, a time, or an integer beyond 2^53."""
    UNREACHABLE = 5
    """No value, and no map above it that could contain one: `has()` of it is unknown, not false."""


_, _NUMBER, _BOOLEAN, _TEXT, _OTHER, _ = map(int, Tag)
"""The tags as plain integers: access to members of an enum is slow in Python 3.11."""


@final
class _Sentinel:
    def __init__(self, name: str) -> None:
        self._name = name

    def __repr__(self) -> str:
        return self._name


MISSING: Final = _Sentinel("MISSING")
"""Instead of a value: the map has no such field."""
NOWHERE: Final = _Sentinel("NOWHERE")
"""Instead of a value: the field belongs to a value that is not a map, or is absent itself."""


class Texts:
    """Assigns a code to each string. Codes are small integers, and never change in the lifetime of the object."""

    __slots__ = ("_codes", "_texts")

    def __init__(self) -> None:
        self._codes: dict[str, int] = {}
        self._texts: list[str] = []

    def __len__(self) -> int:
        return len(self._texts)

    def code(self, text: str) -> int:
        """The code of the string; NUL in it is `␀`, as in every expression.

        Raises UnicodeEncodeError for a lone surrogate, which no expression supports.
        """
        found = self._codes.get(text)
        if found is None:
            text.encode()
            if "\0" in text:
                return self.code(text.replace("\0", "␀"))
            found = self._codes[text] = len(self._texts)
            self._texts.append(text)
        return found

    def text(self, code: int) -> str:
        """The string of a code. Raises IndexError for a code that was never assigned."""
        return self._texts[code]


@dataclass(slots=True)
class Column:
    """One value for each of n rows."""

    values: Doubles
    """float64[n]: the number, 1.0 or 0.0 for a boolean, the code of a string, or 0.0 otherwise."""
    tags: Bytes | None
    """uint8[n]: a `Tag` for each row; None: every row is a number."""
    others: Objects | None = None
    """object[n]: the values whose tag is OTHER; None: there are none, or they are not kept."""


def column_of(values: Sequence[object] | Doubles, texts: Texts) -> Column:
    """The column of plain values, one per row, of the types that `Expression.evaluate_or_unknown` accepts.

    None, NaN, UNKNOWN and MISSING are absent; NOWHERE is unreachable. Integers up to 2^53 become doubles.
    """
    if isinstance(values, np.ndarray):
        return _column_of_doubles(values)
    column = _column_of_numbers(values)
    if column is not None:
        return column
    doubles: list[float] = []
    tags: list[Tag] = []
    for value in values:
        tag, double = _entry(value, texts)
        tags.append(tag)
        doubles.append(double)
    others: Objects | None = None
    for row, tag in enumerate(tags) if Tag.OTHER in tags else ():
        if others is None:
            others = np.full(len(tags), None, dtype=object)
        if tag is Tag.OTHER:
            others[row] = values[row]
    return Column(np.array(doubles, np.float64), np.array(tags, np.uint8), others)


def _column_of_numbers(values: Sequence[object]) -> Column | None:
    """The column of values that are all doubles, small integers or None; None if there are other values."""
    kinds = set(map(type, values))
    if not kinds <= _NUMERIC:
        return None
    try:
        doubles = np.array(values, np.float64)  # None becomes NaN
    except OverflowError:
        return None
    if int in kinds and not bool((np.abs(doubles) < MAX_EXACT).all(where=~np.isnan(doubles))):
        return None
    return _column_of_doubles(doubles)


def _column_of_doubles(doubles: Doubles) -> Column:
    absent = np.isnan(doubles)
    if not absent.any():
        return Column(doubles, None)
    return Column(np.where(absent, 0.0, doubles), np.where(absent, np.uint8(Tag.ABSENT), np.uint8(Tag.NUMBER)))


_NUMERIC: Final = frozenset({float, int, type(None)})
_NOTHING: Final = ((None, Tag.ABSENT), (UNKNOWN, Tag.ABSENT), (MISSING, Tag.ABSENT), (NOWHERE, Tag.UNREACHABLE))


def _entry(value: object, texts: Texts) -> tuple[Tag, float]:
    if type(value) is float:
        return (Tag.NUMBER, value) if value == value else (Tag.ABSENT, 0.0)  # noqa: PLR0124 (NaN alone differs)
    if type(value) is str:
        try:
            return Tag.TEXT, float(texts.code(value))
        except UnicodeEncodeError:
            return Tag.OTHER, 0.0
    if type(value) is bool:
        return Tag.BOOLEAN, 1.0 if value else 0.0
    if type(value) is int:
        number = integer(value)
        return (Tag.NUMBER, number) if isinstance(number, float) else (Tag.OTHER, 0.0)
    for nothing, tag in _NOTHING:
        if value is nothing:
            return tag, 0.0
    return _rare_entry(value, texts)


def _rare_entry(value: object, texts: Texts) -> tuple[Tag, float]:
    if isinstance(value, np.generic):  # before the plain types: numpy's double is one of them
        return _entry(value.item(), texts)
    if isinstance(value, str):  # such as a member of an enum
        return _entry(str.__str__(value), texts)
    if isinstance(value, int):
        return _entry(int(value), texts)
    return _entry(float(value), texts) if isinstance(value, float) else (Tag.OTHER, 0.0)


def value_at(column: Column, row: int, texts: Texts) -> Value | Unknown:
    """The value of a row, as `evaluate_or_unknown` returns it; UNKNOWN if the row is absent.

    Raises ValueError for a row whose tag is OTHER in a column without `others`.
    """
    double: float = column.values.item(row)
    tag = _NUMBER if column.tags is None else column.tags.item(row)
    if tag == _NUMBER:
        return double
    if tag == _BOOLEAN:
        return double != 0
    if tag == _TEXT:
        return texts.text(int(double))
    if tag != _OTHER:
        return UNKNOWN
    if column.others is None:
        raise ValueError(f"row {row} has a value that this column cannot represent: evaluate it with CEL")
    return cast("Value", column.others[row])


def stacked(columns: Sequence[Column], size: int) -> tuple[Doubles, Bytes | None]:
    """The values and tags of columns of this size, as arguments for `Program.run`; no tags: all are numbers."""
    values = np.empty((len(columns), size))
    for at, column in enumerate(columns):
        values[at] = column.values
    if all(column.tags is None for column in columns):
        return values, None
    tags = np.full(values.shape, Tag.NUMBER, np.uint8)
    for at, column in enumerate(columns):
        if column.tags is not None:
            tags[at] = column.tags
    return values, tags
