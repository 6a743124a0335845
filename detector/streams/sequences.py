"""Losses before the detector, detected by the publishers' sequence numbers.

A publisher counts its samples one by one. The first sample gives the current number; a later step of more than one
gives the number of losses. A lower number is a late sample; a number far off means that the publisher restarted.
"""

from __future__ import annotations

from detector.streams.tally import Cause, Tally

MAXIMUM_PUBLISHERS = 10_000
"""Maximum number of tracked publishers of a stream; beyond it, the oldest one is forgotten."""

_RESTARTED = 2**32
"""A step of this size is no loss, but a restart: no publisher sends that many samples unnoticed."""

_BACK = 1000
"""A number this far back is no late sample."""


class Sequences:
    """Tracks the sequence numbers of a stream's publishers; only for the thread that receives the stream."""

    __slots__ = ("_last", "_stream", "_tally")

    def __init__(self, stream: str, tally: Tally) -> None:
        self._stream = stream
        self._tally = tally
        self._last: dict[bytes, int] = {}

    def follow(self, publisher: bytes, number: int, topic: str) -> None:
        """A sample with this number arrived from the publisher."""
        last = self._last.get(publisher)
        if last is not None and number == last + 1:
            self._last[publisher] = number
            return
        if last is None:
            if len(self._last) >= MAXIMUM_PUBLISHERS:
                del self._last[next(iter(self._last))]
            self._last[publisher] = number
        elif last < number < last + _RESTARTED:
            self._last[publisher] = number
            which = str(last + 1) if number == last + 2 else f"{last + 1} to {number - 1}"
            missed = f"{topic}: {which} of publisher {publisher.hex()}"
            self._tally.add(Cause.MISSED, self._stream, number - last - 1, missed)
        elif last - _BACK < number <= last:
            if number < last:
                self._tally.add(Cause.OVERTAKEN, self._stream, last=topic)
        else:
            self._last[publisher] = number
