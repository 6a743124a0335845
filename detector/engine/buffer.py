"""The samples of the last seconds, per client and stream, within a duration and a number of bytes.

Inserting costs the same however much is held: a sample is appended, and one that comes late moves only past those that
are newer than it.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Collection, Iterator, Mapping

from detector.engine.sample import Sample

_OVERHEAD = 160
"""What a sample costs in memory beside its payload, in bytes: its tuple, its numbers and its place in the deque."""

_SLACK = 64
"""Beyond the cap over all streams, 1/64 of it is freed at once, so that the search for the oldest pays off."""


class Lane:
    """The samples of one client on one stream, in order of time."""

    __slots__ = ("bytes", "captures", "client", "duration", "evicted", "maximum_bytes", "samples", "stream")

    def __init__(
        self, client: str, stream: str, captures: Mapping[str, str], duration: int, maximum_bytes: int | None
    ) -> None:
        """`duration` is in nanoseconds; `captures` are what the stream's key captured."""
        self.client = client
        self.stream = stream
        self.captures = captures
        self.duration = duration
        self.maximum_bytes = maximum_bytes
        self.samples: deque[Sample] = deque()
        self.bytes = 0
        self.evicted = 0
        """Samples that a cap pushed out before their time."""

    @property
    def newest(self) -> Sample | None:
        """The sample of the greatest time; of several, the one that arrived last."""
        return self.samples[-1] if self.samples else None

    def insert(self, sample: Sample) -> int:
        """Put the sample in its place; returns by how many bytes the lane grew."""
        samples = self.samples
        if samples and sample.time < samples[-1].time:
            later = []
            while samples and samples[-1].time > sample.time:
                later.append(samples.pop())
            samples.append(sample)
            samples.extend(reversed(later))
        else:
            samples.append(sample)
        size = len(sample.payload) + _OVERHEAD
        self.bytes += size
        if self.maximum_bytes is not None:
            while self.bytes > self.maximum_bytes and len(samples) > 1:
                size -= self.drop_oldest()
                self.evicted += 1
        return size

    def drop_oldest(self) -> int:
        """Forget the oldest sample; returns the bytes freed."""
        size = len(self.samples.popleft().payload) + _OVERHEAD
        self.bytes -= size
        return size

    def expire(self, now: int) -> int:
        """Forget what is older than the duration, but never the newest; returns the bytes freed."""
        samples, horizon, freed = self.samples, now - self.duration, 0
        while len(samples) > 1 and samples[0].time <= horizon:
            freed += self.drop_oldest()
        return freed

    def newest_first(self, after: int | None, until: int) -> Iterator[Sample]:
        """The samples of (after, until] from the newest on; all up to `until` where `after` is None."""
        for sample in reversed(self.samples):
            if after is not None and sample.time <= after:
                return
            if sample.time <= until:
                yield sample


class Buffer:
    """All lanes, and the cap over them."""

    def __init__(self, maximum_bytes: int) -> None:
        """`maximum_bytes` bounds the payloads and their overhead over all lanes."""
        self.maximum_bytes = maximum_bytes
        self.bytes = 0
        self._lanes: dict[tuple[str, str], Lane] = {}

    def lane(self, client: str, stream: str) -> Lane | None:
        """The client's lane of the stream, if it ever had one."""
        return self._lanes.get((client, stream))

    def add(self, lane: Lane) -> Lane:
        """Take the lane in; the one that is there already where there is one."""
        return self._lanes.setdefault((lane.client, lane.stream), lane)

    def grew(self, size: int) -> None:
        """Account for what was inserted, and keep to the cap."""
        self.bytes += size
        if self.bytes > self.maximum_bytes:
            self._shrink()

    def expire(self, now: int) -> None:
        """Forget what is older than the lanes' durations."""
        for lane in self._lanes.values():
            self.bytes -= lane.expire(now)

    def forget(self, client: str) -> list[Lane]:
        """Drop all lanes of a client; returns them."""
        gone = [lane for lane in self._lanes.values() if lane.client == client]
        for lane in gone:
            del self._lanes[lane.client, lane.stream]
            self.bytes -= lane.bytes
        return gone

    def keep(self, streams: Collection[str]) -> None:
        """Drop the lanes of all other streams."""
        self._lanes = {key: lane for key, lane in self._lanes.items() if lane.stream in streams}
        self.bytes = sum(lane.bytes for lane in self._lanes.values())

    def clear(self) -> None:
        """Forget all samples; the lanes stay."""
        for lane in self._lanes.values():
            lane.samples.clear()
            lane.bytes = 0
        self.bytes = 0

    @property
    def evicted(self) -> int:
        """Samples that a cap pushed out before their time."""
        return sum(lane.evicted for lane in self._lanes.values())

    def __iter__(self) -> Iterator[Lane]:
        return iter(self._lanes.values())

    def _shrink(self) -> None:
        """Free the oldest samples over all lanes."""
        target = self.maximum_bytes - self.maximum_bytes // _SLACK
        heads = [(lane.samples[0].time, index, lane) for index, lane in enumerate(self._lanes.values()) if lane.samples]
        heapq.heapify(heads)
        while self.bytes > target and heads:
            _, index, lane = heads[0]
            self.bytes -= lane.drop_oldest()
            lane.evicted += 1
            if lane.samples:
                heapq.heapreplace(heads, (lane.samples[0].time, index, lane))
            else:
                heapq.heappop(heads)
