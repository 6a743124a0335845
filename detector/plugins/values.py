"""Converts plugins' values to values of expressions: numbers become doubles, and only plain data is accepted."""

from __future__ import annotations

import math
from typing import Any

from wayside.expressions import Value

_DEEPEST = 32
_EXACT = 2**53


def plain_value(value: Any, depth: int = _DEEPEST) -> Value:
    """The value with integers as doubles and tuples as lists; NaN becomes None, at any depth.

    Raises TypeError for other data, and for data nested too deeply.
    """
    match value:
        case None | bool() | str():
            return value
        case int():
            return float(value) if -_EXACT <= value <= _EXACT else int(value)
        case float():
            return None if math.isnan(value) else float(value)
        case list() | tuple() if depth:
            return [plain_value(item, depth - 1) for item in value]
        case dict() if depth and all(isinstance(key, str) for key in value):
            return {key: plain_value(item, depth - 1) for key, item in value.items()}
    if not depth:
        raise TypeError(f"the value is nested more than {_DEEPEST} levels deep")
    scalar = getattr(value, "item", None)  # numpy's numbers
    if scalar is not None and getattr(value, "shape", None) == ():
        return plain_value(scalar(), depth - 1)
    raise TypeError(
        f"the value is a {type(value).__name__}: return None, a boolean, a number, a text, or lists and "
        "maps (with text keys) of these"
    )
