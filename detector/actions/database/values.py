"""Any decoded message as BSON: fast for plain values, with conversions for others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bson
import numpy as np
from bson.datetime_ms import DatetimeMS
from bson.decimal128 import Decimal128

_INT64 = range(-(2**63), 2**63)
_DEPTH = 100
"""MongoDB refuses documents with deeper nesting."""


class UnfitError(ValueError):
    """A message that cannot be a document; the message of the error gives the reason."""


def bson_bytes(document: Mapping[str, Any]) -> bytes:
    """The document as BSON.

    Numbers are preserved: NaN and infinities are doubles, integers beyond 64 bits become Decimal128, or text if that
    has too few digits. Raises UnfitError if it is nested too deeply.
    """
    try:
        return bson.encode(document)
    except (bson.errors.BSONError, ValueError, OverflowError, TypeError, RecursionError):
        return bson.encode(bson_values(document))


def bson_values(document: Mapping[str, Any]) -> dict[str, Any]:
    """The document with BSON's types only. Raises UnfitError if it is nested too deeply."""
    made: dict[str, Any] = _plain(document, 0)
    return made


def _plain(value: Any, depth: int) -> Any:
    if depth > _DEPTH:
        raise UnfitError(f"it is nested more than {_DEPTH} levels deep")
    match value:
        case np.generic():
            return _plain(value.item(), depth)  # first: numpy's doubles are Python's as well
        case None | bool() | float() | bson.Int64() | DatetimeMS() | bson.Binary():
            return value
        case int():
            return value if value in _INT64 else _wide(value)
        case str():
            return value.encode("utf-8", "replace").decode()  # lone surrogates are invalid in BSON text
        case bytes() | bytearray() | memoryview():
            return bytes(value)
        case Mapping():
            return {_name(key): _plain(each, depth + 1) for key, each in value.items()}
        case np.ndarray():
            return _plain(value.tolist(), depth)
        case list() | tuple():
            return [_plain(each, depth + 1) for each in value]
        case set() | frozenset():
            return [_plain(each, depth + 1) for each in sorted(value, key=repr)]
        case _:
            return str(value)  # values of CBOR tags: dates, fractions, UUIDs


def _wide(value: int) -> Decimal128 | str:
    return Decimal128(str(value)) if len(str(abs(value))) <= 34 else str(value)


def _name(key: Any) -> str:
    """A field's name. BSON ends names at NUL: it is replaced by its symbol."""
    text = key if isinstance(key, str) else str(key)
    return text.replace("\0", "\N{SYMBOL FOR NULL}").encode("utf-8", "replace").decode()
