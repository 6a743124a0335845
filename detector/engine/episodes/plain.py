"""Values as JSON carries them: without null, NaN and infinities in maps, and with lists in place of tuples."""

from __future__ import annotations

import json
from collections.abc import Mapping
from json.encoder import encode_basestring
from math import isfinite
from typing import Any

from wayside.api.base import JsonValue

to_text = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode
"""JSON on one line. Raises ValueError for NaN and infinities, TypeError for what JSON does not have."""

quote = encode_basestring
"""A text as JSON has it, with quotes. The same as `to_text`, without its set-up."""

_UNCHANGED = frozenset({bool, float, int, str})
"""Exact types that JSON carries as they are; finite numbers only."""


def plain(values: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """The values as JSON can carry them: nulls, NaN and infinities are left out, tuples become lists."""
    return {
        key: value if type(value) in _UNCHANGED else _plain(value)
        for key, value in values.items()
        if not _is_null(value)
    }


def plain_text(values: Mapping[str, JsonValue]) -> str:
    """The same text as `to_text(plain(values))`. Most values are single numbers and texts: those need no encoder.

    Raises:
        TypeError: JSON does not have such a value.
    """
    parts = []
    for key, value in values.items():
        kind = type(value)
        if kind is float:
            if isfinite(value):
                parts.append(f"{quote(key)}:{value!r}")
        elif kind is str:
            parts.append(f"{quote(key)}:{quote(value)}")
        elif not _is_null(value):
            parts.append(f"{quote(key)}:{to_text(_plain(value))}")
    return f"{{{','.join(parts)}}}"


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        # An item's place has a meaning, so here null stays.
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
