"""Cuts a recording into parts for the engine: large ones, because each call has a fixed cost."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from operator import attrgetter

from detector.engine.samples.sample import Arrival

PAUSE = 3600 * 1_000_000_000
"""Nanoseconds: a longer pause in a recording is a gap; evaluating empty years is useless."""

_ARRIVALS = 1 << 16
_BYTES = 64 << 20
_STEP = 4096
"""A part is cut to within this number of arrivals."""

_received = attrgetter("received")


def parts_of(batches: Iterable[Sequence[Arrival]]) -> Iterator[Sequence[Arrival]]:
    """The arrivals in non-empty parts of at most about 65,536 arrivals or 64 MiB of payload.

    All arrivals of one time are in one part, regardless of their number. A pause longer than `PAUSE` ends a part.
    """
    part: list[Arrival] = []
    size = 0
    for piece in _pieces(batches):
        if part and piece[0].received - part[-1].received > PAUSE:
            yield part
            part, size = [], 0
        part += piece
        size += sum([len(arrival.payload) for arrival in piece])
        if len(part) >= _ARRIVALS or size >= _BYTES:
            # Arrivals of the last time wait: more of that time may follow.
            cut = bisect_left(part, part[-1].received, key=_received)
            if cut:
                yield part[:cut]
                part = part[cut:]
                size = sum([len(arrival.payload) for arrival in part])
    if part:
        yield part


def _pieces(batches: Iterable[Sequence[Arrival]]) -> Iterator[Sequence[Arrival]]:
    """Short pieces without a pause inside."""
    for batch in batches:
        for begin in range(0, len(batch), _STEP):
            piece = batch[begin : begin + _STEP]
            cuts = [0, *_pauses(piece, 0, len(piece) - 1), len(piece)]
            yield from (piece[first:last] for first, last in pairwise(cuts))


def _pauses(arrivals: Sequence[Arrival], first: int, last: int) -> Iterator[int]:
    """The indices up to `last` before which there is a pause. Only halves that contain one are searched."""
    if arrivals[last].received - arrivals[first].received <= PAUSE:
        return
    if last - first == 1:
        yield last
        return
    middle = (first + last) // 2
    yield from _pauses(arrivals, first, middle)
    yield from _pauses(arrivals, middle, last)
