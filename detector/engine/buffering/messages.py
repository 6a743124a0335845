"""The values that expressions over one sample read: payloads are decoded on first use, and stamps are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from detector.engine.buffering.items import Items
from detector.engine.counters import Counters
from detector.engine.samples.sample import DecodeError, Decoder, Item, LinkedSample, NearDecoder, PreviousSample, Sample
from wayside.expressions import UNKNOWN, EvaluationError
from wayside.rules import CompiledStream

_MISSING: Any = object()

_RECEIVED = "sample.received"
"""The `stamp` of a stream that uses the receive time as the stamp: `t` of JSON lines."""

_SECOND = 10**9
"""An integer: Python divides integers to the nearest double, where a double of nanoseconds would be 256 ns off."""


class KeyReader(Protocol):
    """Finds the client of a sample."""

    def __call__(self, stream: str, key: str) -> tuple[str, Mapping[str, str]] | None:
        """The client and the captured chunks; None if the key names no valid client."""


class Messages:
    """Decodes payloads when an expression needs them, each at most once a tick."""

    def __init__(
        self,
        decoders: Mapping[str, Decoder],
        streams: Mapping[str, CompiledStream],
        read_key: KeyReader,
        items: Items,
        counters: Counters,
    ) -> None:
        self.items = items
        self._decoders = decoders
        self._near = {stream: each for stream, each in decoders.items() if isinstance(each, NearDecoder)}
        self._streams = streams
        self._read_key = read_key
        self._counters = counters
        self._decoded: dict[tuple[str, Sample], Any] = {}
        self._stamps: dict[tuple[str, Sample], int | None] = {}
        self._previous_stamps: dict[tuple[str, Sample], int | None] = {}
        """The stamps read in the previous tick that read any: plugins read the same samples tick after tick."""
        self._last_stamp: tuple[tuple[str, int, bytes], int | None] | None = None

    def forget(self) -> None:
        """Drop the decoded messages: the tick is over."""
        self._decoded.clear()
        if self._stamps:
            self._previous_stamps, self._stamps = self._stamps, {}

    def content(self, stream: str, sample: Sample) -> Any:
        """The client's data: for a stream with `items` the item, otherwise the message; UNKNOWN as in `message`."""
        message = self.message(stream, sample)
        if message is UNKNOWN or not isinstance(sample, Item):
            return message
        return self.items.read(stream, sample.payload).items[sample.place]

    def _before(self, stream: str, before: PreviousSample | None) -> Any:
        """The client's previous data; UNKNOWN if there is none, or if it cannot be read (already counted)."""
        if before is None:
            return UNKNOWN
        if before.place >= 0:
            return self.items.read(stream, before.payload).items[before.place]
        try:
            return self._decoders[stream].decode(before.payload)
        except DecodeError:
            return UNKNOWN

    def message(self, stream: str, sample: Sample) -> Any:
        """The decoded message of a sample; UNKNOWN, and counted, if the message cannot be read."""
        if isinstance(sample, Item):
            return self.items.read(stream, sample.payload).message  # it was readable on receipt
        at = (stream, sample)
        message = self._decoded.get(at, _MISSING)
        if message is _MISSING:
            try:
                message = self._decoders[stream].decode(sample.payload)
            except DecodeError as error:
                self.unreadable(stream, sample, error)
                return UNKNOWN
            self._decoded[at] = message
        return message

    def unreadable(self, stream: str, sample: Sample, error: DecodeError) -> None:
        """Count a sample that cannot be read, at most once a tick."""
        if (stream, sample) not in self._decoded:
            self._decoded[stream, sample] = UNKNOWN
            self._unreadable(stream, sample.key, error)

    def values(
        self, stream: str, sample: Sample, names: frozenset[str], parameters: Mapping[str, Any]
    ) -> dict[str, Any] | None:
        """The variables of an expression over one sample; None if the sample cannot be read."""
        values: dict[str, Any] = {"parameters": parameters}
        if "msg" in names:
            message = self.message(stream, sample)
            if message is UNKNOWN:
                return None
            values["msg"] = message
        if "item" in names:
            values["item"] = self.content(stream, sample)
        if "before" in names and isinstance(sample, LinkedSample | Item):
            before = self._before(stream, sample.before)
            if before is not UNKNOWN:
                values["before"] = before
        if "key" in names:
            parsed = self._read_key(stream, sample.key)
            values["key"] = {} if parsed is None else parsed[1]
        if "sample" in names:
            try:
                stamp = self._stamp_of(stream, sample)
            except (DecodeError, EvaluationError, ValueError):
                stamp = None
            values["sample"] = {
                "received": sample.received / _SECOND,
                "size": float(len(sample.payload)),
                **({} if stamp is None else {"stamp": stamp / _SECOND, "latency": (sample.received - stamp) / _SECOND}),
            }
        return values

    def stamp(self, stream: str, sample: Sample) -> int | None:
        """The stamp of a sample in the buffer: see `time`. It is cached while each tick reads the sample."""
        at = (stream, sample)
        stamp: int | None = self._stamps.get(at, _MISSING)
        if stamp is _MISSING:
            stamp = self._previous_stamps.get(at, _MISSING)
            if stamp is _MISSING:
                stamp = self.time(stream, sample.key, sample.received, sample.payload)
            self._stamps[at] = stamp
        return stamp

    def time(self, stream: str, key: str, received: int, payload: bytes) -> int | None:
        """A sample's time with clock Data, in nanoseconds: its stamp, or the receive time if it has none.

        None, and counted as unreadable, if the stamp cannot be read.
        """
        try:
            stamp = self._stamp(stream, payload, received)
        except (DecodeError, EvaluationError, ValueError) as error:
            self._unreadable(stream, key, error)
            return None
        self._counters.stamped(stream, received, stamp)
        return received if stamp is None else stamp

    def _stamp_of(self, stream: str, sample: Sample) -> int | None:
        """The stamp of a sample, as in `_stamp`; consecutive items of one message share one read."""
        if not isinstance(sample, Item):
            return self._stamp(stream, sample.payload, sample.received)
        about = stream, sample.received, sample.payload
        if self._last_stamp is None or self._last_stamp[0] != about:
            self._last_stamp = about, self._stamp(stream, sample.payload, sample.received)
        return self._last_stamp[1]

    def _stamp(self, stream: str, payload: bytes, received: int) -> int | None:
        """The sender's time in nanoseconds, if the message has one."""
        decoder, expression = self._decoders[stream], self._streams[stream].stamp
        if expression is None:
            near = self._near.get(stream)
            return decoder.stamp(payload) if near is None else near.stamp_near(payload, received)
        if expression.source.strip() == _RECEIVED:
            return received  # a double of seconds would round it
        values: dict[str, Any] = {"sample": {"received": received / _SECOND}}
        if "msg" in expression.names:
            values["msg"] = decoder.decode(payload)
        return _nanoseconds(expression.evaluate(values))

    def _unreadable(self, stream: str, key: str, error: Exception) -> None:
        self._counters.unreadable(stream, key, error)


def _nanoseconds(seconds: object) -> int:
    """A stamp in seconds, to the microsecond: a double has no greater precision for a time since the epoch."""
    if not isinstance(seconds, int | float) or not 0 <= seconds < 1e11:
        raise ValueError(f"stamp must be a time in seconds since the epoch; got {seconds!r}")
    return round(seconds * 1e6) * 1000
