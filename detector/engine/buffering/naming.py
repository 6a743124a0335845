"""The clients of a stream: those that can have samples of the stream, and those that a message names.

A stream's `client` may be a template over the message, or over its items.

Such messages are decoded as they enter the buffer, on the thread that evaluates, never on the one that receives.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from detector.engine.buffering.items import Items, below
from detector.engine.counters import Counters
from detector.engine.samples.sample import DecodeError, Decoder
from wayside.api.stream import Stream
from wayside.expressions import CompiledTemplate, EvaluationError, InterpolationError
from wayside.keys import KeyPattern
from wayside.rules import CompiledStream

CLIENT_NAME = re.compile(r"(?!\.*$)[A-Za-z0-9._:-]{1,63}")
"""Valid names of clients. Names of only dots are invalid: they would escape from a folder or a URL's path."""

MAXIMUM_ITEMS = 2048
"""Maximum number of items of one message; further ones are dropped and counted."""

_MAXIMUM_NAMES = 65_536
"""Maximum number of cached names; beyond it, the cache is emptied."""


class MessageClients:
    """Reads the names of clients from messages."""

    def __init__(
        self,
        decoders: Mapping[str, Decoder],
        streams: Mapping[str, CompiledStream],
        items: Items,
        counters: Counters,
    ) -> None:
        self._decoders = decoders
        self._namers = {name: _Namer(stream.client) for name, stream in streams.items() if stream.client is not None}
        self._items = items
        self._counters = counters

    def __contains__(self, stream: str) -> bool:
        """Whether the messages of the stream name their client."""
        return stream in self._namers

    def client(self, stream: str, key: str, captures: Mapping[str, str], payload: bytes) -> str | None:
        """The client's name; None, and counted, if the message cannot be read or yields no valid name."""
        try:
            message = self._decoders[stream].decode(payload)
        except DecodeError as error:
            self._counters.unreadable(stream, key, error)
            return None
        return self._name(stream, key, {"msg": message, "key": captures})

    def of_items(self, stream: str, key: str, captures: Mapping[str, str], payload: bytes) -> dict[str, int]:
        """The clients of a message's items, and the index of each; items that are no list or have no valid name are
        counted.

        A client has one item per message: the first with its name.
        """
        try:
            message, items = self._items.read(stream, payload)
        except DecodeError as error:
            self._counters.unreadable(stream, key, error)
            return {}
        except EvaluationError as error:
            self._unnamed(stream, f"{key}: items: {error}")
            return {}
        found: dict[str, int] = {}
        for place, item in enumerate(items[:MAXIMUM_ITEMS]):
            name = self._name(stream, key, {"item": item, "msg": message, "key": captures})
            if name is None:
                continue
            if found.setdefault(name, place) != place:
                self._unnamed(stream, f"{key}: client: two items of one message have the name {name}")
        if len(items) > MAXIMUM_ITEMS:
            self._counters.crowded[stream] += len(items) - MAXIMUM_ITEMS
        return found

    def _name(self, stream: str, key: str, values: Mapping[str, Any]) -> str | None:
        """A name; None, and counted, if these values yield no valid one."""
        try:
            name = self._namers[stream].name(values)
        except InterpolationError as error:
            self._unnamed(stream, f"{key}: client: {error}")
            return None
        if name is None or not CLIENT_NAME.fullmatch(name):
            self._unnamed(
                stream,
                f"{key}: client: must have 1 to 63 of A-Z a-z 0-9 . _ : -, not dots alone; got {name!r}",
            )
            return None
        return name

    def _unnamed(self, stream: str, reason: str) -> None:
        self._counters.unnamed[stream] += 1
        self._counters.last_unnamed[stream] = reason


class _Namer:
    """Renders a `client` template and caches the name by the values of the fields that it reads."""

    def __init__(self, template: CompiledTemplate) -> None:
        self._template = template
        self._paths = sorted(template.paths, key=str)
        self._names: dict[tuple[Any, ...], str] = {}

    def name(self, values: Mapping[str, Any]) -> str | None:
        """The name, which may be invalid. Raises InterpolationError."""
        read = tuple([below(values, path) for path in self._paths])
        plain = all(map(_is_plain, read))
        kinds = (*read, *map(type, read))  # 1.0 and true are equal, but render as different names
        if plain and (name := self._names.get(kinds)) is not None:
            return name
        rendered = self._template.render(values, integers=True)
        name = rendered if isinstance(rendered, str) else None if rendered is None else str(rendered)
        if plain and name is not None:
            if len(self._names) >= _MAXIMUM_NAMES:
                self._names.clear()
            self._names[kinds] = name
        return name


def _is_plain(value: Any) -> bool:
    """Whether equal values of this type render the same: 0.0 and -0.0 do not, and NaN equals nothing."""
    return type(value) in (str, bool) or (type(value) is float and value != 0 and value == value)  # noqa: PLR0124


class PossibleStreams:
    """Whether a client can ever have samples of a stream, by the stream's key and `client`."""

    def __init__(self, streams: Iterable[Stream]) -> None:
        self._limits = {stream.name: limit for stream in streams if (limit := _limit(stream)) is not None}

    @property
    def limited(self) -> bool:
        """Whether any stream is limited to some clients."""
        return bool(self._limits)

    def __call__(self, stream: str, client: str) -> bool:
        """Whether the client can have samples of the stream; true for names that are no stream of the Detector."""
        limit = self._limits.get(stream)
        return limit is None or limit(client)


def _limit(stream: Stream) -> Callable[[str], bool] | None:
    """The clients that can have samples; None: all."""
    if stream.client is None:
        pattern = KeyPattern.parse(stream.key)
        return None if "${client:*}" in stream.key else lambda client: pattern.can_capture("client", client)
    if not stream.names_by_message:
        return stream.client.__eq__
    prefix = stream.client.partition("${")[0]
    return (lambda client: client.startswith(prefix)) if prefix else None
