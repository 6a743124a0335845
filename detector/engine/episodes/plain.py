"""Values in the form of JSON: without null, NaN and infinities in maps, and with lists in place of tuples."""

from __future__ import annotations

import json
from collections.abc import Mapping
from json.encoder import encode_basestring
from math import isfinite
from typing import Any

from wayside.api.base import JsonValue

to_text = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode
"""JSON on one line. Raises ValueError for NaN and infinities, TypeError for other types than JSON's."""

quote = encode_basestring
"""A text as a quoted JSON string. The same as `to_text`, without its set-up."""

_UNCHANGED = frozenset({bool, float, int, str})
"""Exact types that JSON represents unchanged; finite numbers only."""


def plain(values: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """The values in the form of JSON: nulls, NaN and infinities are left out, tuples become lists."""
    return {
        key: value if type(value) in _UNCHANGED else _plain(value)
        for key, value in values.items()
        if not _is_null(value)
    }


def plain_text(values: Mapping[str, JsonValue]) -> str:
    """The same text as `to_text(plain(values))`. Most values are single numbers and texts, which need no encoder.

    Raises:
        TypeError: a value has another type than JSON's.
    """
    parts = []
    for key, value in values.items():
        kind = type(value)
        if kind is float:
            if isfinite(value):
                parts.append(f"{quote(key)}:{value!r}")
        elif kind is str:
            parts.append(f"{quote(key)}:{quote(value)}")
        elif kind is bool:
            parts.append(f"{quote(key)}:{'true' if value else 'false'}")
        elif kind is int:
            parts.append(f"{quote(key)}:{value}")
        elif not _is_null(value):
            parts.append(f"{quote(key)}:{to_text(_plain(value))}")
    return f"{{{','.join(parts)}}}"


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        # The position of an item has a meaning, so null stays in lists.
        return [None if _is_null(item) else item if type(item) in _UNCHANGED else _plain(item) for item in value]
    if isinstance(value, Mapping):
        return {
            str(key): child if type(child) in _UNCHANGED else _plain(child)
            for key, child in value.items()
            if not _is_null(child)
        }
    return value


def _is_null(value: Any) -> bool:
    return value is None or (isinstance(value, float) and not isfinite(value))
