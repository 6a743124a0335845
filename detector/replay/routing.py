"""Which streams a recorded message belongs to, as the subscriptions decide it live."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import cbor2
import msgspec

from detector.assembly import DetectorError
from detector.engine.samples.sample import Arrival
from detector.replay.errors import RecordingError
from detector.replay.message import Message
from wayside.api.stream import Encoding, Stream
from wayside.keys import KeyPattern
from wayside.rules import stream_problems

_SHOWN = 20

_WRITERS: Mapping[Encoding, Callable[[object], bytes]] = {
    Encoding.JSON: msgspec.json.encode,  # bytes become base64, NaN and infinities null
    Encoding.CBOR: cbor2.dumps,
}
"""How a message that the recording alone can decode is handed to a stream."""


def _written(message: Message, stream: Stream) -> bytes:
    """The payload as the stream's encoding has it; as it is where it cannot be read, for the stream to count it."""
    write = _WRITERS.get(stream.encoding)
    if write is None or message.decode is None:
        return message.payload
    try:
        return write(message.decode(message.payload))
    except ValueError:
        return message.payload


class Router:
    """Sends recorded messages into the Detector's streams."""

    def __init__(self, streams: Sequence[Stream], recording: str = "") -> None:
        """`recording` is its name for errors. Raises DetectorError where a stream's key or an expression is wrong."""
        self._where = f"{recording}: " if recording else ""
        problems = [problem for index, stream in enumerate(streams) for problem in stream_problems(stream, index)]
        if problems:
            raise DetectorError(problems)
        self._streams = [(stream, KeyPattern.parse(stream.key)) for stream in streams]
        self._routes: dict[str, tuple[Stream, ...]] = {}
        self._fits: set[tuple[str, str, str | None]] = set()

    def wanted(self, key: str) -> bool:
        """Whether the key belongs to any stream."""
        return bool(self._route(key))

    def route(self, key: str) -> tuple[str, ...]:
        """The names of all streams that the key belongs to, in the Detector's order."""
        return tuple(stream.name for stream in self._route(key))

    @property
    def unrouted(self) -> list[str]:
        """Keys that were looked at and belong to no stream, at most twenty, sorted."""
        return sorted(key for key, streams in self._routes.items() if not streams)[:_SHOWN]

    def routed(self, messages: Iterable[Message]) -> Iterator[tuple[Message, tuple[Stream, ...]]]:
        """Each message that belongs to any stream, with all its streams in the Detector's order.

        Raises RecordingError where a message is recorded in another encoding or type than its stream's.
        """
        for message in messages:
            streams = self._route(message.key)
            for stream in streams:
                self._check(message, stream)
            if streams:
                yield message, streams

    def arrivals(self, messages: Iterable[Message]) -> Iterator[Arrival]:
        """The messages as the live intake would have queued them, each once for every stream of its key.

        The receive time is the recorded one: equal times stay equal, in the order of the messages and then of the
        streams. A time that goes back becomes the last one before it. Raises RecordingError like `routed`.
        """
        time = 0
        for message, streams in self.routed(messages):
            time = max(time, message.time)
            for stream in streams:
                payload = message.payload if message.decode is None else _written(message, stream)
                yield Arrival(time, stream.name, message.key, payload)

    def _route(self, key: str) -> tuple[Stream, ...]:
        streams = self._routes.get(key)
        if streams is None:
            streams = tuple(stream for stream, pattern in self._streams if pattern.match(key) is not None)
            self._routes[key] = streams
        return streams

    def _check(self, message: Message, stream: Stream) -> None:
        """Raises RecordingError unless the stream can read the message; each combination is looked at once."""
        recorded = (stream.name, message.encoding, message.type)
        if recorded in self._fits:
            return
        if message.decode is not None and stream.encoding not in (*_WRITERS, Encoding.RAW):
            raise RecordingError(
                f"{self._where}{message.key} is recorded as {message.encoding}, which replay turns into json or cbor, "
                f"but streams[{stream.name}].encoding is {stream.encoding.value}: write json, cbor or raw"
            )
        as_recorded = message.decode is None and stream.encoding is not Encoding.RAW
        if as_recorded and message.encoding != stream.encoding.value:
            raise RecordingError(
                f"{self._where}{message.key} is recorded as {message.encoding}, but streams[{stream.name}].encoding is "
                f"{stream.encoding.value}: correct it, or the stream's key"
            )
        if stream.encoding is Encoding.CDR and message.type not in (None, "", stream.type):
            raise RecordingError(
                f"{self._where}{message.key} is recorded as {message.type}, but "
                f"streams[{stream.name}].type is {stream.type}: correct it, or the stream's key"
            )
        self._fits.add(recorded)
