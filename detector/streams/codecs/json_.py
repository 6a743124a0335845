"""JSON: read by msgspec, then its integers are converted to doubles.

Invalid JSON (NaN, Infinity, trailing commas) is rejected. Of a repeated key, the last one counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from detector.engine.samples.sample import DecodeError, FieldReader
from detector.streams.codecs.doubles import as_double
from detector.streams.codecs.json_fields import json_fields
from detector.streams.codecs.paths import Path

MAX_DEPTH = 64
"""Maximum nesting of maps and lists: no real message comes near it, and a hostile one must not exhaust the stack."""

_read = msgspec.json.Decoder().decode


class JsonDecoder:
    """Reads JSON of any shape; the stream's configuration names its stamp."""

    def decode(self, payload: bytes) -> Any:
        """The value. Raises DecodeError for anything but one JSON value in UTF-8, nested at most MAX_DEPTH deep."""
        try:
            value = _read(payload)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise DecodeError(f"not JSON: {error}") from None
        except RecursionError:
            # msgspec bounds its depth, so the stack is safe: it reports deep nesting by this error.
            raise _too_deep() from None
        return _with_doubles(value, MAX_DEPTH)

    def stamp(self, payload: bytes) -> int | None:
        """None: the stream's configuration names the field of the stamp."""
        return None

    def field_reader(self, paths: Sequence[Path]) -> FieldReader | None:
        """A reader of only these paths; None for an index at the beginning of a path, and for names with control
        characters, quotes or backslashes."""
        return json_fields(paths, self.decode, lambda value: _with_doubles(value, MAX_DEPTH), MAX_DEPTH)


def _with_doubles(value: Any, depth: int) -> Any:
    """The value with its integers as doubles; maps and lists are changed in place."""
    kind = type(value)
    if kind is int:
        return as_double(value)
    if kind is dict:
        if depth == 0:
            raise _too_deep()
        for key, item in value.items():
            if type(item) not in _DONE:
                value[key] = _with_doubles(item, depth - 1)
    elif kind is list:
        if depth == 0:
            raise _too_deep()
        for index, item in enumerate(value):
            if type(item) not in _DONE:
                value[index] = _with_doubles(item, depth - 1)
    return value


_DONE = frozenset((float, str, bool, type(None)))


def _too_deep() -> DecodeError:
    return DecodeError(f"JSON nested more than {MAX_DEPTH} levels deep")
