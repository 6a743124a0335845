"""Messages with lists of objects: a stream's `items` names the list, and each item is a separate sample.

The samples share the message's payload. A message is decoded when it enters the buffer, to find its clients, and again
soon afterwards, when rules read it. Therefore the newest messages are cached.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from detector.engine.samples.sample import MISSING, Decoder
from wayside.expressions import Expression, Path
from wayside.rules import CompiledStream

_MAXIMUM_BYTES = 4 * 2**20
"""Maximum size of the payloads of cached messages; the oldest are removed first."""


class DecodedList(NamedTuple):
    """A decoded message, and the list in it."""

    message: Any
    items: list[Any]


class Items:
    """Reads the items of messages."""

    def __init__(self, decoders: Mapping[str, Decoder], streams: Mapping[str, CompiledStream]) -> None:
        self._decoders = decoders
        self._lists = {
            name: (stream.items, stream.items.path) for name, stream in streams.items() if stream.items is not None
        }
        self._cached: dict[tuple[str, bytes], DecodedList] = {}
        self._bytes = 0

    def __contains__(self, stream: str) -> bool:
        """Whether the messages of the stream are lists of items."""
        return stream in self._lists

    def read(self, stream: str, payload: bytes) -> DecodedList:
        """A message and its list. Raises DecodeError, and EvaluationError if there is no list."""
        listed = self._cached.get((stream, payload))
        if listed is None:
            message = self._decoders[stream].decode(payload)
            listed = DecodedList(message, _list(*self._lists[stream], message))
            self._store(stream, payload, listed)
        return listed

    def _store(self, stream: str, payload: bytes, listed: DecodedList) -> None:
        self._bytes += len(payload)
        while self._bytes > _MAXIMUM_BYTES and self._cached:
            oldest = next(iter(self._cached))
            del self._cached[oldest]
            self._bytes -= len(oldest[1])
        self._cached[stream, payload] = listed


def below(value: Any, path: Path) -> Any:
    """The value at the path below a value; MISSING if there is none."""
    for step in path:
        if isinstance(value, dict):
            value = value.get(step, MISSING)
        elif isinstance(value, list) and isinstance(step, int) and step < len(value):
            value = value[step]
        else:
            return MISSING
    return value


def _list(expression: Expression, path: Path | None, message: Any) -> list[Any]:
    """The list of items. A plain path is read without CEL, because CEL copies its results."""
    found = MISSING if path is None else below(message, path[1:])
    if isinstance(found, list):
        return found
    evaluated = expression.evaluate({"msg": message})
    assert isinstance(evaluated, list)  # noqa: S101  it was compiled for this type
    return evaluated
