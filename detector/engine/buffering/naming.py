"""The client of a message that names it: a stream's `client` is a template over the message.

Such messages are decoded as they enter the buffer, on the thread that evaluates, never on the one that receives.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from detector.engine.counters import Counters
from detector.engine.samples.sample import DecodeError, Decoder
from wayside.expressions import CompiledTemplate, InterpolationError
from wayside.rules import CompiledStream

CLIENT_NAME = re.compile(r"(?!\.*$)[A-Za-z0-9._:-]{1,63}")
"""What a client's name is made of. Dots alone are none: they would be a way out of a folder or of a URL's path."""


class MessageClients:
    """Reads the names of clients out of messages."""

    def __init__(
        self, decoders: Mapping[str, Decoder], streams: Mapping[str, CompiledStream], counters: Counters
    ) -> None:
        self._decoders = decoders
        self._templates: dict[str, CompiledTemplate] = {
            name: stream.client for name, stream in streams.items() if stream.client is not None
        }
        self._counters = counters

    def __contains__(self, stream: str) -> bool:
        """Whether the messages of the stream name their client."""
        return stream in self._templates

    def client(self, stream: str, key: str, captures: Mapping[str, str], payload: bytes) -> str | None:
        """The client's name; None, and counted, where the message cannot be read or yields no valid name."""
        try:
            message = self._decoders[stream].decode(payload)
        except DecodeError as error:
            self._counters.unreadable(stream, key, error)
            return None
        try:
            rendered = self._templates[stream].render({"msg": message, "key": captures}, integers=True)
        except InterpolationError as error:
            self._unnamed(stream, f"{key}: client: {error}")
            return None
        name = rendered if isinstance(rendered, str) else None if rendered is None else str(rendered)
        if name is None or not CLIENT_NAME.fullmatch(name):
            self._unnamed(
                stream, f"{key}: client: {name!r} is no name: it takes 1 to 63 of A-Z a-z 0-9 . _ : -, not dots alone"
            )
            return None
        return name

    def _unnamed(self, stream: str, reason: str) -> None:
        self._counters.unnamed[stream] += 1
        self._counters.last_unnamed[stream] = reason
