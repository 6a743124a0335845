"""The publish time of a message, if it contains one."""

from __future__ import annotations

from collections.abc import Callable

from detector.actions.base import Surroundings
from detector.actions.episode import EpisodeSample
from detector.engine.samples.sample import DecodeError, NearDecoder
from wayside.api.detector import Clock
from wayside.expressions import EvaluationError
from wayside.rules import compile_stream

_Stamp = Callable[[EpisodeSample], int | None]
_LATEST = 2**63 - 1


class Stamps:
    """Reads the stamps of messages, as defined by the Detector for each stream."""

    def __init__(self, surroundings: Surroundings) -> None:
        self._surroundings = surroundings
        self._data = surroundings.detector.spec.clock is Clock.DATA
        self._stamps: dict[str, _Stamp] = {}

    def publish_time(self, sample: EpisodeSample) -> int:
        """Nanoseconds since the epoch: the message's stamp, or its receive time if it has none."""
        if self._data:
            return sample.time  # which is the stamp
        read = self._stamps.get(sample.stream)
        if read is None:
            read = self._stamps[sample.stream] = self._reader(sample.stream)
        try:
            stamp = read(sample)
        except (DecodeError, EvaluationError, ValueError):
            stamp = None
        return sample.received if stamp is None or not 0 <= stamp <= _LATEST else stamp

    def _reader(self, name: str) -> _Stamp:
        stream, decoder = self._surroundings.detector.spec.stream(name), self._surroundings.decoders.get(name)
        if stream is None or decoder is None:
            return lambda sample: None
        expression = compile_stream(stream, 0).stamp
        if expression is not None:
            return lambda sample: _nanoseconds(expression.evaluate({"msg": decoder.decode(sample.payload)}))
        if isinstance(decoder, NearDecoder):
            near = decoder
            return lambda sample: near.stamp_near(sample.payload, sample.received)
        return lambda sample: decoder.stamp(sample.payload)


def _nanoseconds(seconds: object) -> int | None:
    """To the microsecond: a double has no greater precision for a time since the epoch."""
    if not isinstance(seconds, int | float) or not 0 <= seconds < 1e11:
        return None
    return round(seconds * 1e6) * 1000
