"""The streams of a recorded message, by the same rules as live subscriptions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import cbor2
import msgspec

from detector.assembly import DetectorError
from detector.engine.samples.sample import Arrival
from detector.replay.batches import Batch, Channel
from detector.replay.message import RecordingError
from wayside.api.stream import Encoding, Stream
from wayside.keys import KeyPattern
from wayside.rules import stream_problems

_SHOWN = 20

_WRITERS: Mapping[Encoding, Callable[[object], bytes]] = {
    Encoding.JSON: msgspec.json.encode,  # bytes become base64, NaN and infinities null
    Encoding.CBOR: cbor2.dumps,
}
"""Encodes a message that only the recording can decode, for a stream."""


class _Target(NamedTuple):
    """A stream for the messages of a channel."""

    stream: str
    key: str
    write: Callable[[bytes], bytes] | None
    """Converts the payload to the stream's encoding; None if it is passed on unchanged."""


def _writer(channel: Channel, stream: Stream) -> Callable[[bytes], bytes] | None:
    """Converts a payload to the stream's encoding; an unreadable one stays unchanged, and the stream counts it."""
    write, decode = _WRITERS.get(stream.encoding), channel.decode
    if write is None or decode is None:
        return None

    def written(payload: bytes) -> bytes:
        try:
            return write(decode(payload))
        except ValueError:
            return payload

    return written


class MessageRouter:
    """Routes recorded messages to the Detector's streams."""

    def __init__(self, streams: Sequence[Stream], recording: str = "") -> None:
        """`recording` is its name for errors. Raises DetectorError if a stream's key or an expression is invalid."""
        self._where = f"{recording}: " if recording else ""
        problems = [problem for index, stream in enumerate(streams) for problem in stream_problems(stream, index)]
        if problems:
            raise DetectorError(problems)
        self._streams = [(stream, KeyPattern.parse(stream.key)) for stream in streams]
        self._routes: dict[str, tuple[Stream, ...]] = {}
        self._targets: dict[Channel, tuple[_Target, ...]] = {}

    def wanted(self, key: str) -> bool:
        """Whether the key belongs to any stream."""
        return bool(self._route(key))

    @property
    def unrouted(self) -> list[str]:
        """Keys that belong to no stream, at most twenty, sorted."""
        return sorted(key for key, streams in self._routes.items() if not streams)[:_SHOWN]

    def routed(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """The messages that belong to any stream.

        Raises RecordingError if a message has another encoding or type than its stream.
        """
        for batch in batches:
            there = set(batch.channels)
            if new := there - self._targets.keys():
                for channel in dict.fromkeys(each for each in batch.channels if each in new):
                    try:
                        self._targets[channel] = self._targets_of(channel)
                    except RecordingError:
                        if first := batch.channels.index(channel):
                            yield from self.routed([batch.part(0, first)])
                        raise
            if all(self._targets[channel] for channel in there):
                yield batch
            elif positions := [at for at, channel in enumerate(batch.channels) if self._targets[channel]]:
                yield batch.picked(positions)

    def arrivals(self, batches: Iterable[Batch]) -> Iterator[list[Arrival]]:
        """The messages in the form of the live intake, each once for every stream of its key.

        The receive time is the recorded one: equal times stay equal, in the order of the messages and then of the
        streams. A time that goes back is replaced by the latest one before it. Lists are not empty. Raises
        RecordingError like `routed`.
        """
        last = 0
        targets = self._targets
        for batch in self.routed(batches):
            times = batch.times if batch.times[0] >= last else [max(time, last) for time in batch.times]
            last = times[-1]
            yield [
                Arrival(time, stream, key, payload if write is None else write(payload))
                for time, channel, payload in zip(times, batch.channels, batch.payloads, strict=True)
                for stream, key, write in targets[channel]
            ]

    def _targets_of(self, channel: Channel) -> tuple[_Target, ...]:
        """The channel's streams in the Detector's order. Raises RecordingError if one cannot read it."""
        streams = self._route(channel.key)
        for stream in streams:
            self._check(channel, stream)
        return tuple(_Target(stream.name, channel.key, _writer(channel, stream)) for stream in streams)

    def _route(self, key: str) -> tuple[Stream, ...]:
        streams = self._routes.get(key)
        if streams is None:
            streams = tuple(stream for stream, pattern in self._streams if pattern.match(key) is not None)
            self._routes[key] = streams
        return streams

    def _check(self, channel: Channel, stream: Stream) -> None:
        """Raises RecordingError unless the stream can read the channel's messages."""
        if channel.decode is not None and stream.encoding not in (*_WRITERS, Encoding.RAW):
            raise RecordingError(
                f"{self._where}{channel.key} is recorded as {channel.encoding}, which replay turns into json or cbor, "
                f"but streams[{stream.name}].encoding is {stream.encoding.value}: write json, cbor or raw"
            )
        as_recorded = channel.decode is None and stream.encoding is not Encoding.RAW
        if as_recorded and channel.encoding != stream.encoding.value:
            raise RecordingError(
                f"{self._where}{channel.key} is recorded as {channel.encoding}, but streams[{stream.name}].encoding is "
                f"{stream.encoding.value}: correct it, or the stream's key"
            )
        if stream.encoding is Encoding.CDR and channel.type not in (None, "", stream.type):
            raise RecordingError(
                f"{self._where}{channel.key} is recorded as {channel.type}, but "
                f"streams[{stream.name}].type is {stream.type}: correct it, or the stream's key"
            )
