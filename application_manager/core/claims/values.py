"""Compares and orders JSON values by meaning: 1 and 1.0 are one value, true and 1 are two."""

from __future__ import annotations

import json
from typing import Any

_EXACT = 2**53


def normal(value: Any) -> Any:
    """The value with integral numbers as integers, so that equal values have equal bytes everywhere."""
    match value:
        case bool():
            return value
        case float() if value.is_integer() and abs(value) <= _EXACT:
            return int(value)
        case list():
            return [normal(item) for item in value]
        case dict():
            return {key: normal(item) for key, item in value.items()}
    return value


def canonical(value: Any) -> str:
    """One text for each value: JSON without spaces, keys sorted, integral numbers without a point."""
    return json.dumps(normal(value), ensure_ascii=False, sort_keys=True, separators=(",", ":"))


def text(value: Any) -> str:
    """The value as text, as `${…}` inside a text gives it: a text unchanged, any other value as JSON."""
    return value if isinstance(value, str) else canonical(value)


def sort_key(value: Any) -> tuple[int, float, str]:
    """Sort key for all JSON values: null, booleans, numbers by size, texts, then lists and maps by their JSON."""
    match value:
        case None:
            return (0, 0.0, "")
        case bool():
            return (1, float(value), "")
        case int() | float():
            return (2, float(value), "")
        case str():
            return (3, 0.0, value)
    return (4, 0.0, canonical(value))


def shown(value: Any, limit: int = 80) -> str:
    """The value for a message, shortened if it is long."""
    whole = json.dumps(value, ensure_ascii=False)
    return whole if len(whole) <= limit else whole[: limit - 1] + "…"
