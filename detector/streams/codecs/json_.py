"""JSON: read by msgspec, then its integers are converted to doubles.

Invalid JSON (NaN, Infinity, trailing commas) is rejected. Of a repeated key, the last one counts.

A few fields are read by msgspec structs that have only these. msgspec skips fields that a struct does not have, and
checks them less strictly than the decoder: neither UTF-8, nor the size of numbers, nor our bound on the depth. Payloads
that may fail these checks are decoded as a whole, and so is every message that does not fit the structs. The decoder
thus decides what is accepted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

import msgspec

from detector.engine.samples.sample import MISSING, DecodeError, FieldReader, Fields
from detector.streams.codecs.paths import Path, complete, shortest, spread
from wayside.expressions.numbers import as_double

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
        """A reader of only these paths; None if one begins with an index or has a control character, quote or \\."""
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


_SLICE = 64
"""Number of payloads that are checked together: an unusual one slows only these."""
_PLAIN = frozenset((float, str, bool, type(None), type(MISSING)))

_SHAPE = bytes.maketrans(b"0123456789E", b"0000000000e")
_LARGE = b"0e000"
"""Any exponent of three digits, after replacing digits by zeros; without one, a large number needs many digits."""
_MANY = b"0" * 200

_BRACKETS = bytes.maketrans(b"{}", b"[]")
_NO_BRACKETS = bytes(set(range(256)) - set(b'[]{}"'))


def json_fields(
    paths: Sequence[Path], decode: Callable[[bytes], Any], plain: Callable[[Any], Any], max_depth: int
) -> FieldReader | None:
    """A reader of the paths; None if no struct can have them: an index at the beginning, or an unusual name.

    `decode` reads a whole payload and rejects a nesting of more than `max_depth`; `plain` converts a value of msgspec
    as `decode` does.
    """
    names = [path[: next((at for at, step in enumerate(path) if type(step) is int), len(path))] for path in paths]
    if () in names:
        return None
    whole = shortest(names)
    try:
        root = _struct(whole)
    except (ValueError, UnicodeEncodeError):  # a name with a quote, a control character or half a surrogate pair
        return None
    getters = [attrgetter(_attributes(path, whole)) for path in whole]
    read = msgspec.json.Decoder(root).decode

    def messages_of(part: Sequence[bytes]) -> list[Any] | None:
        try:
            messages = list(map(read, part))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None
        return messages if _sure(part, max_depth) else None

    def read_fields(payloads: Sequence[bytes]) -> Fields:
        messages: list[Any] = []
        left: list[int] = []
        for first in range(0, len(payloads), _SLICE):
            part = payloads[first : first + _SLICE]
            found = messages_of(part)
            if found is not None:
                messages += found
                continue
            for place, payload in enumerate(part, start=first):
                found = messages_of((payload,))
                if found is None:
                    left.append(place)
                else:
                    messages += found
        columns = [_converted(list(map(get, messages)), plain) for get in getters]
        return spread(complete(payloads, columns, whole, left, decode), whole, paths)

    return read_fields


def _struct(paths: Sequence[Path]) -> type[msgspec.Struct]:
    """A struct with the paths. Raises ValueError for names that no struct can have."""
    fields: list[tuple[str, Any, Any]] = []
    for at, (name, below) in enumerate(_members(paths).items()):
        kind: Any = object if below == [()] else _struct(below)
        default = MISSING if kind is object else kind()
        fields.append((f"f{at}", kind, msgspec.field(default=default, name=str(name))))
    return msgspec.defstruct("Message", fields, frozen=True, gc=False)


def _attributes(path: Path, paths: Sequence[Path]) -> str:
    """The attributes of the paths' struct for this path."""
    members = _members(paths)
    attribute = f"f{list(members).index(path[0])}"
    return f"{attribute}.{_attributes(path[1:], members[path[0]])}" if path[1:] else attribute


def _members(paths: Sequence[Path]) -> dict[str | int, list[Path]]:
    """The rest of the paths below each first step."""
    members: dict[str | int, list[Path]] = {}
    for path in paths:
        members.setdefault(path[0], []).append(path[1:])
    return members


def _converted(column: list[Any], plain: Callable[[Any], Any]) -> list[Any]:
    """The column in the decoder's form."""
    kinds = set(map(type, column))
    if kinds <= _PLAIN:
        return column
    if dict in kinds or list in kinds:
        return [plain(value) for value in column]
    return [as_double(value) if type(value) is int else value for value in column]


def _sure(payloads: Sequence[bytes], max_depth: int) -> bool:
    """Whether the decoder certainly accepts these payloads, which have been read as structs."""
    joined = b"".join(payloads)
    if not joined.isascii():
        try:
            for payload in payloads:
                payload.decode()
        except UnicodeDecodeError:
            return False
    shape = joined.translate(_SHAPE, b"+")
    if _LARGE in shape:
        return False
    longest = max(map(len, payloads))
    if longest >= len(_MANY) and _MANY in shape:
        return False
    return longest <= 2 * max_depth or all(_depth_is_within(max_depth, payload) for payload in payloads)


def _depth_is_within(bound: int, payload: bytes) -> bool:
    """Whether the nesting of a valid payload is certainly within the bound."""
    if payload.count(b"[") + payload.count(b"{") <= bound:
        return True
    if b"\\" in payload:
        payload = payload.replace(b"\\\\", b"").replace(b'\\"', b"")
    # Texts without brackets are reduced to their two quotes.
    brackets = payload.translate(_BRACKETS, _NO_BRACKETS).replace(b'""', b"")
    for _ in range(bound):
        brackets = brackets.replace(b"[]", b"")  # keeps the deepest of each branch
    return not brackets
