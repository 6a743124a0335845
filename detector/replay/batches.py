"""Recorded messages in batches, so that work common to many messages is done once.

Every reader yields batches. `batched` wraps readers of formats that return single messages.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter

from detector.engine.samples.sample import Arrival
from detector.replay.message import Message

MAXIMUM_MESSAGES = 4096
MAXIMUM_BYTES = 8 << 20
"""Maximum bytes of payload in a batch, exceeded by at most one message."""
_ONE_BY_ONE = 256
"""Maximum number of messages in a batch of a reader of single messages: live playback waits while a batch is read."""


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """The common properties of the messages of one key; two channels are equal only if they are the same object."""

    key: str
    """As in `Message`, like the other fields."""
    encoding: str
    type: str | None
    decode: Callable[[bytes], object] | None = None


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages in time order; lists of equal length, not empty.

    A time that goes back, in a recording that is out of order, begins a new batch.
    """

    times: list[int]
    """Nanoseconds since the epoch."""
    channels: list[Channel]
    payloads: list[bytes]

    def part(self, begin: int, end: int) -> Batch:
        """The messages from index `begin` to before `end`."""
        return Batch(self.times[begin:end], self.channels[begin:end], self.payloads[begin:end])

    def picked(self, positions: Sequence[int]) -> Batch:
        """The messages at these indices."""
        return Batch(
            [self.times[at] for at in positions],
            [self.channels[at] for at in positions],
            [self.payloads[at] for at in positions],
        )


def messages_of(batches: Iterable[Batch]) -> Iterator[Message]:
    """The messages one by one."""
    for batch in batches:
        for time, channel, payload in zip(batch.times, batch.channels, batch.payloads, strict=True):
            yield Message(time, channel.key, payload, channel.encoding, channel.type, channel.decode)


def batched(messages: Iterable[Message]) -> Iterator[Batch]:
    """The messages in batches. If `messages` raises an error, the messages before it are yielded first."""
    channels: dict[tuple[object, ...], Channel] = {}
    batch, size = Batch([], [], []), 0
    try:
        for message in messages:
            full = len(batch.times) >= _ONE_BY_ONE or size >= MAXIMUM_BYTES
            if batch.times and (full or message.time < batch.times[-1]):
                yield batch
                batch, size = Batch([], [], []), 0
            common = message.key, message.encoding, message.type, message.decode
            channel = channels.get(common)
            if channel is None:
                channel = channels[common] = Channel(*common)
            batch.times.append(message.time)
            batch.channels.append(channel)
            batch.payloads.append(message.payload)
            size += len(message.payload)
    except Exception:
        if batch.times:
            yield batch
        raise
    if batch.times:
        yield batch


def merged_batches(recordings: Sequence[Iterator[Batch]]) -> Iterator[Batch]:
    """The messages of all recordings by time; of equal times, those of the recording given first.

    If the times of a recording go back, its messages wait for earlier ones of the others, as in `heapq.merge`.
    """
    if len(recordings) == 1:
        yield from recordings[0]
        return
    heads = [(batch, rest) for rest in recordings if (batch := next(rest, None)) is not None]
    while heads:
        # All messages up to the earliest end of a batch are known: only this batch's recording may continue at the same
        # time.
        ending = min(range(len(heads)), key=lambda at: heads[at][0].times[-1])
        limit = heads[ending][0].times[-1]
        cuts = [
            (bisect_right if at <= ending else bisect_left)(batch.times, limit) for at, (batch, _) in enumerate(heads)
        ]
        yield _sorted([batch.part(0, cut) for (batch, _), cut in zip(heads, cuts, strict=True) if cut])
        heads = [
            (left, rest)
            for (batch, rest), cut in zip(heads, cuts, strict=True)
            if (left := batch.part(cut, len(batch.times)) if cut < len(batch.times) else next(rest, None)) is not None
        ]


def _sorted(parts: Sequence[Batch]) -> Batch:
    if len(parts) == 1:
        return parts[0]
    together = Batch(
        [time for part in parts for time in part.times],
        [channel for part in parts for channel in part.channels],
        [payload for part in parts for payload in part.payloads],
    )
    return together.picked(sorted(range(len(together.times)), key=together.times.__getitem__))  # stable


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
