"""Field readers must give the same values as decoding whole messages and reading the fields."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from detector.engine.samples.sample import MISSING, DecodeError, FieldColumn, FieldDecoder

Path = tuple[str | int, ...]


def assert_reads_as_decoded(decoder: FieldDecoder, paths: Sequence[Path], payloads: Sequence[bytes]) -> int:
    """The reader's values, errors and odd places are those of the decoder; returns how many payloads are refused."""
    reader = decoder.field_reader(paths)
    assert reader is not None
    found = reader(payloads)
    columns: list[list[Any]] = [[] for _ in paths]
    errors, odd = {}, set()
    for place, payload in enumerate(payloads):
        try:
            message = decoder.decode(payload)
        except DecodeError as error:
            errors[place] = str(error)
            for column in columns:
                column.append(MISSING)
            continue
        for path, column in zip(paths, columns, strict=True):
            value, is_odd = looked_up(message, path)
            column.append(value)
            if is_odd:
                odd.add(place)
    assert {place: str(error) for place, error in found.errors.items()} == errors
    assert list(found.odd) == sorted(odd)
    # The text of a value also distinguishes doubles from integers and booleans, and the two zeros.
    assert [repr(plain(column)) for column in found.columns] == [repr(column) for column in columns], payloads
    return len(errors)


def plain(column: FieldColumn) -> list[Any]:
    """The column's values as decoded."""
    return column.tolist() if isinstance(column, np.ndarray) else list(column)


def looked_up(value: Any, path: Path) -> tuple[Any, bool]:
    """The value at the path, and whether the path goes through what has no members."""
    for step in path:
        if isinstance(value, list) and isinstance(step, int):
            if step >= len(value):
                return MISSING, False
        elif not isinstance(value, dict):
            return MISSING, True
        elif step not in value:
            return MISSING, False
        value = value[step]
    return value, False
