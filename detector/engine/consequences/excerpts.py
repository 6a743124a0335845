"""Excerpts: the samples of an episode's window, each exactly once.

    ──(begin … onset … start … end … until]──▶ time

Samples in the buffer at the beginning of an excerpt belong to it. From then on its lanes record each sample inserted
into them, including late ones and ones that are evicted later. A sample is released only once time has reached it: only
then it is certain that the episode had not ended before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

from detector.engine.buffering.buffer import Buffer, Lane
from detector.engine.samples.sample import Item, Sample
from wayside.rules import CompiledWindow


class EpisodeSample(NamedTuple):
    """One message of an episode's window, as it was received."""

    client: str
    stream: str
    key: str
    """The full key of the message, without a leading slash."""
    time: int
    """Its time on the detector's time axis, in nanoseconds since the epoch."""
    received: int
    """Nanoseconds since the epoch; the stamp as well with clock Data."""
    payload: bytes
    """The payload as received, undecoded; for a stream with `items` the whole message, once for all its clients."""


_TIME = attrgetter("time")
_CLIENT = attrgetter("client")


@dataclass(slots=True, eq=False)
class Excerpt:
    """The samples of one window. Times are nanoseconds."""

    window: CompiledWindow
    clients: frozenset[str] | None
    """None: all."""
    begin: int
    """Samples after this time belong to it; of latched streams, also the last sample before."""
    until: int | None = None
    """Samples up to this time belong to it; None while the episode is open."""
    waiting: list[tuple[Lane, Sample]] = field(default_factory=list)
    """Samples that time has not reached yet, or that have not been taken."""
    lanes: list[Lane] = field(default_factory=list)
    """The lanes of its samples."""

    def wants(self, lane: Lane) -> bool:
        """Whether the lane belongs to the window's streams and clients."""
        if lane.stream in self.window.shared:
            return True
        if lane.stream not in self.window.streams and lane.stream not in self.window.latched:
            return False
        return self.clients is None or lane.client in self.clients

    def take(self, now: int) -> list[EpisodeSample]:
        """The samples that time has reached, in time order; samples outside of the window are discarded."""
        reached = now if self.until is None else min(now, self.until)
        taken: list[EpisodeSample] = []
        listed: dict[tuple[str, int], EpisodeSample] = {}
        """Messages with items that belong to the window, by stream and number: each is one sample, attributed to the
        first client."""
        waiting: list[tuple[Lane, Sample]] = []
        for lane, sample in self.waiting:
            time = sample.time
            if time > reached:
                if self.until is None or time <= self.until:
                    waiting.append((lane, sample))
            elif time > self.begin or lane.latched:
                found = EpisodeSample(lane.client, lane.stream, sample.key, time, sample.received, sample.payload)
                if isinstance(sample, Item):
                    message = (lane.stream, sample.number)
                    listed[message] = min(found, listed.get(message, found), key=_CLIENT)
                else:
                    taken.append(found)
        self.waiting = waiting
        taken += listed.values()
        taken.sort(key=_TIME)
        return taken


class Excerpts:
    """All open excerpts of a buffer."""

    def __init__(self, buffer: Buffer) -> None:
        self._buffer = buffer
        self._watchers: dict[Lane, list[Excerpt]] = {}
        self._excerpts: list[Excerpt] = []
        buffer.on_added = self._added

    def begin(self, window: CompiledWindow, clients: frozenset[str] | None, begin: int) -> Excerpt:
        """Begin another excerpt: it contains the samples in the buffer, and those that arrive from now on."""
        self.distribute()
        excerpt = Excerpt(window, clients, begin)
        self._excerpts.append(excerpt)
        # There may be many clients, and an episode is about one or two of them.
        every = clients is None or window.shared
        for lane in self._buffer if every else self._buffer.of(sorted(clients or ())):
            if excerpt.wants(lane):
                self._watch(lane, excerpt)
                excerpt.waiting.extend((lane, sample) for sample in lane.samples)
        return excerpt

    def stop(self, excerpt: Excerpt) -> None:
        """No more samples follow for this excerpt."""
        self._excerpts.remove(excerpt)
        for lane in excerpt.lanes:
            self._watchers[lane].remove(excerpt)
            if not self._watchers[lane]:
                del self._watchers[lane]
                lane.record(None)

    def _added(self, lane: Lane) -> None:
        """Add a lane that is new in the buffer."""
        for excerpt in self._excerpts:
            if excerpt.wants(lane):
                self._watch(lane, excerpt)

    def _watch(self, lane: Lane, excerpt: Excerpt) -> None:
        watchers = self._watchers.setdefault(lane, [])
        if not watchers:
            lane.record([])
        watchers.append(excerpt)
        excerpt.lanes.append(lane)

    def distribute(self) -> None:
        """Give each excerpt the samples that arrived since the last call."""
        for lane, came in self._came():
            for excerpt in self._watchers[lane]:
                excerpt.waiting.extend((lane, sample) for sample in came)

    def _came(self) -> Iterator[tuple[Lane, list[Sample]]]:
        """The samples inserted into the lanes since the last call."""
        for lane in self._watchers:
            came = lane.came
            if came:
                lane.record([])
                yield lane, came
