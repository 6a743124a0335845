"""Losses before the detector, seen by the numbers that publishers give their samples.

A publisher counts its samples one by one. The first that comes says where it stands; a step of more than one afterwards
says how many did not come. A number that is passed already came late; one far off means that counting began anew.
"""

from __future__ import annotations

from detector.streams.tally import Cause, Tally

MAXIMUM_PUBLISHERS = 10_000
"""So many publishers of a stream are remembered; beyond, the one that was first seen longest ago begins anew."""

_ANEW = 2**32
"""A step this far is no loss: no publisher sends so much while nobody looks."""

_BACK = 1000
"""A number this far back is no late sample."""


class Sequences:
    """Follows the numbers of a stream's publishers; for the one thread that receives the stream."""

    __slots__ = ("_last", "_stream", "_tally")

    def __init__(self, stream: str, tally: Tally) -> None:
        self._stream = stream
        self._tally = tally
        self._last: dict[bytes, int] = {}

    def follow(self, publisher: bytes, number: int, topic: str) -> None:
        """A sample with this number came from the publisher."""
        last = self._last.get(publisher)
        if last is not None and number == last + 1:
            self._last[publisher] = number
            return
        if last is None:
            if len(self._last) >= MAXIMUM_PUBLISHERS:
                del self._last[next(iter(self._last))]
            self._last[publisher] = number
        elif last < number < last + _ANEW:
            self._last[publisher] = number
            which = str(last + 1) if number == last + 2 else f"{last + 1} to {number - 1}"
            missed = f"{topic}: {which} of publisher {publisher.hex()}"
            self._tally.add(Cause.MISSED, self._stream, number - last - 1, missed)
        elif last - _BACK < number <= last:
            if number < last:
                self._tally.add(Cause.OVERTAKEN, self._stream, last=topic)
        else:
            self._last[publisher] = number
