"""Which clients can have samples of which streams: impossible ones are not counted as missing."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from wayside.api.stream import Stream
from wayside.keys import KeyPattern


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
