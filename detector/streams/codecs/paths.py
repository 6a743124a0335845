"""Paths into messages: which fields must be read for them, and how they are looked up in decoded values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from detector.engine.samples.sample import MISSING, DecodeError, FieldColumn, Fields

Path = tuple[str | int, ...]

_ODD: Final = object()
"""The path goes through a value without members."""


def shortest(paths: Iterable[Path]) -> list[Path]:
    """The paths without those that lie below another one, without duplicates; the shorter ones first."""
    kept: dict[Path, None] = {}
    for path in sorted(paths, key=len):
        if not any(path[:length] in kept for length in range(len(path) + 1)):
            kept[path] = None
    return list(kept)


def complete(
    payloads: Sequence[bytes],
    columns: Sequence[FieldColumn],
    read: Sequence[Path],
    left: Sequence[int],
    decode: Callable[[bytes], Any],
) -> Fields:
    """The columns of the paths `read`, completed by decoding as a whole the payloads at the indices `left`.

    The columns hold the values of all other payloads, in order.
    """
    if not left:
        return Fields(columns, {}, ())
    errors: dict[int, DecodeError] = {}
    odd: list[int] = []
    rows: list[list[Any]] = []
    for place in left:
        try:
            message = decode(payloads[place])
        except DecodeError as error:
            errors[place] = error
            rows.append([MISSING] * len(read))
            continue
        row = [_look_up(message, path) for path in read]
        if any(value is _ODD for value in row):
            odd.append(place)
            row = [MISSING if value is _ODD else value for value in row]
        rows.append(row)
    return Fields([_merged(column, left, [row[at] for row in rows]) for at, column in enumerate(columns)], errors, odd)


def _merged(column: FieldColumn, places: Sequence[int], values: Sequence[Any]) -> list[Any]:
    """The column with the values inserted at their indices."""
    merged: list[Any] = []
    taken = 0
    for place, value in zip(places, values, strict=True):
        until = taken + place - len(merged)
        merged += column[taken:until]
        merged.append(value)
        taken = until
    merged += column[taken:]
    return merged


def spread(fields: Fields, read: Sequence[Path], paths: Sequence[Path]) -> Fields:
    """The columns of `paths`, each of which is one of the paths `read` or lies below one."""
    places = {path: at for at, path in enumerate(read)}
    columns: list[FieldColumn] = []
    odd = set(fields.odd)
    for path in paths:
        length = next(length for length in range(len(path) + 1) if path[:length] in places)
        column, below = fields.columns[places[path[:length]]], path[length:]
        if below:
            found = [value if value is MISSING else _look_up(value, below) for value in column]
            if any(value is _ODD for value in found):
                odd.update(place for place, value in enumerate(found) if value is _ODD)
                found = [MISSING if value is _ODD else value for value in found]
            column = found
        columns.append(column)
    return Fields(columns, fields.errors, sorted(odd))


def _look_up(value: Any, path: Path) -> Any:
    """The value at the path in a decoded value; MISSING or _ODD if there is none."""
    for step in path:
        kind = type(value)
        if kind is dict:
            if step not in value:
                return MISSING
        elif kind is not list or type(step) is not int:
            return _ODD
        elif not 0 <= step < len(value):
            return MISSING
        value = value[step]
    return value
