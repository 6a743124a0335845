"""CBOR (RFC 8949): read by cbor2, then converted to plain values as in JSON.

Values without a form in JSON: byte strings stay bytes, undefined and unassigned simple values become null, and numbers
as keys of maps become text. Tags are replaced by their content: a time stays the text or number that it is. Big
integers and fractions are numbers. References inside a message (tags 28 and 29) are rejected: they could make it
endless.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from io import BytesIO
from typing import Any

import cbor2

from detector.engine.samples.sample import DecodeError
from wayside.expressions.numbers import as_double

MAX_DEPTH = 64
"""Maximum nesting of maps, lists and tags, far from real messages: a hostile one must not exhaust the stack."""


class CborDecoder:
    """Reads CBOR of any shape; the stream's configuration names its stamp."""

    def decode(self, payload: bytes) -> Any:
        """The value. Raises DecodeError for anything but one CBOR data item, nested at most MAX_DEPTH deep."""
        decoder = cbor2.CBORDecoder(BytesIO(payload), tag_hook=_untagged, semantic_decoders=_TAGS, max_depth=MAX_DEPTH)
        try:
            value = _plain(decoder.decode())
        except (cbor2.CBORDecodeError, _ReferenceError) as error:
            raise DecodeError(f"not CBOR: {error.__cause__ or error}") from None
        try:
            decoder.read(1)
        except cbor2.CBORDecodeEOF:
            return value
        raise DecodeError("not CBOR: there are bytes after the data item")

    def stamp(self, payload: bytes) -> int | None:
        """None: the stream's configuration names the field of the stamp."""
        return None


class _ReferenceError(ValueError):
    """A part of the message that refers to another."""


def _plain(value: Any) -> Any:
    """The value without CBOR's own types; cbor2 has bounded its depth."""
    kind = type(value)
    if kind is float or kind is str or kind is bool or value is None or kind is bytes:
        return value
    if kind is int:
        return as_double(value)
    if kind is dict:
        return {key if type(key) is str else _key(key): _plain(item) for key, item in value.items()}
    if kind is list or kind is tuple:
        return [_plain(item) for item in value]
    return None  # undefined, or an unassigned simple value


def _key(key: Any) -> str:
    if type(key) is int:
        return str(as_double(key)).removesuffix(".0")
    raise DecodeError(f"unsupported CBOR: {type(key).__name__} as a key of a map; use strings or integers")


def _untagged(tag: cbor2.CBORTag, immutable: bool) -> Any:
    return tag.value


def _content(value: Any, immutable: bool) -> Any:
    return value


def _reference(value: Any, immutable: bool) -> Any:
    raise _ReferenceError("unsupported CBOR: shared values (tags 28 and 29)")


def _decimal(value: Any, immutable: bool) -> Any:
    exponent, mantissa = _fraction(value)
    return _bounded(lambda: float(f"{mantissa}e{exponent}"))


def _binary(value: Any, immutable: bool) -> Any:
    exponent, mantissa = _fraction(value)
    return _bounded(lambda: math.ldexp(mantissa, exponent))


def _fraction(value: Any) -> tuple[int, int]:
    """Exponent and mantissa. Raises ValueError unless they are two integers of at most 64 bits."""
    match value:
        case [int(exponent), int(mantissa)] if max(abs(exponent), abs(mantissa)) < 2**64:
            return exponent, mantissa
    raise ValueError("a decimal fraction must be two integers, exponent and mantissa")


def _bounded(compute: Callable[[], float]) -> float:
    try:
        return compute()
    except OverflowError:
        return math.inf


_TAGS: Mapping[int, Callable[[Any, bool], Any]] = {
    **dict.fromkeys(
        # times, rational, expression, MIME, UUID, addresses, dates, sets, complex numbers, "this is CBOR"
        (0, 1, 30, 35, 36, 37, 52, 54, 100, 258, 260, 261, 1004, 43000, 55799),
        _content,
    ),
    4: _decimal,
    5: _binary,
    28: _reference,
    29: _reference,
}
"""The conversions of tags that cbor2 would convert to Python objects; big integers (2 and 3) are left to it."""
