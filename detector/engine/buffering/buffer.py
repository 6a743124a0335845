"""The samples of the last seconds, per client and stream, within a duration and a number of bytes.

The cost of an insertion does not depend on the size of the buffer: a sample is appended; a late sample is inserted
before the newer ones.

A sample becomes invisible when it is older than its duration; its memory is freed at the next whole second. Caps are
enforced on each sample as it enters, so the contents depend neither on the batches in which samples arrive nor on the
rules that read them. The oldest sample is evicted first; of equal times, the one that entered first; over all lanes, by
client and then stream.
"""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from operator import attrgetter

from detector.engine.samples.sample import SAMPLE_OVERHEAD, Item, Sample

NEVER = -(2**63)
"""A time before all others: no sample has arrived yet."""

HOUSEKEEPING = 1_000_000_000
"""Period in nanoseconds after which old samples are dropped; each period has a tick, also without rules."""

_RECEIVED = attrgetter("received")

_SLACK = 64
"""When the cap over all streams is exceeded, 1/64 of it is freed at once: the search for the oldest is expensive."""


def bytes_of(samples: Sequence[Sample]) -> int:
    """The memory that the samples take in the buffer, in bytes."""
    return sum([len(sample.payload) for sample in samples]) + SAMPLE_OVERHEAD * len(samples)


class Lane:
    """The samples of one client on one stream, in time order."""

    __slots__ = (
        "_newest_evicted", "bytes", "capped", "client", "duration", "evicted", "inserted", "maximum_bytes",
        "maximum_count", "number", "samples", "stream",
    )  # fmt: skip

    latched = False
    """Whether the last sample stays valid until replaced; the cap over all lanes empties such lanes last."""

    def __init__(
        self,
        client: str,
        stream: str,
        duration: int,
        maximum_bytes: int | None = None,
        maximum_count: int | None = None,
    ) -> None:
        """`duration` is in nanoseconds."""
        self.client = client
        self.stream = stream
        self.number = -1
        """The client's number in the tables (see columns/tables.py); -1 while it has none."""
        self.inserted: list[Sample] | None = None
        """Samples inserted since `record`; None: insertions are not recorded."""
        self.limit(duration, maximum_bytes, maximum_count)
        self.samples: deque[Sample] = deque()
        self.bytes = 0
        self._newest_evicted = NEVER
        """The time of the newest sample, if a cap evicted it."""
        self.evicted = 0
        """Samples that a cap evicted before they expired."""

    def limit(self, duration: int, maximum_bytes: int | None, maximum_count: int | None) -> None:
        """Apply these limits from the next sample and tick on; `duration` is in nanoseconds."""
        self.duration = duration
        self.maximum_bytes = maximum_bytes
        self.maximum_count = maximum_count
        self._update_capped()

    def record(self, inserted: list[Sample] | None) -> None:
        """Append inserted samples to the list from now on, in order of arrival; None: stop."""
        self.inserted = inserted
        self._update_capped()

    def _update_capped(self) -> None:
        self.capped = self.maximum_bytes is not None or self.maximum_count is not None or self.inserted is not None
        """Whether samples must go through `insert`, which enforces the caps and fills `inserted`."""

    @property
    def newest(self) -> Sample | None:
        """The sample with the greatest time; of several, the one that arrived last."""
        return self.samples[-1] if self.samples else None

    @property
    def latest(self) -> int:
        """The greatest time of all samples ever inserted, including evicted ones."""
        return max(self.samples[-1].received, self._newest_evicted) if self.samples else self._newest_evicted

    def insert(self, sample: Sample) -> int:
        """Insert the sample in time order; returns by how many bytes the lane grew."""
        if self.inserted is not None:
            self.inserted.append(sample)
        samples = self.samples
        later = []
        while samples and samples[-1].time > sample.time:
            later.append(samples.pop())
        samples.append(sample)
        samples.extend(reversed(later))
        size = self.size_of(sample)
        self.bytes += size
        if self.maximum_bytes is not None:
            while self.bytes > self.maximum_bytes and len(samples) > 1:
                size -= self.drop_oldest()
                self.evicted += 1
        if self.maximum_count is not None:
            while len(samples) > self.maximum_count:
                size -= self.drop_oldest()
                self.evicted += 1
        return size

    def drop_oldest(self) -> int:
        """Drop the oldest sample; returns the bytes freed."""
        oldest = self.samples.popleft()
        if not self.samples:
            self._newest_evicted = max(self._newest_evicted, oldest.time)
        size = self.size_of(oldest)
        self.bytes -= size
        return size

    def size_of(self, sample: Sample) -> int:
        """The memory that the sample takes in the buffer, in bytes."""
        return len(sample.payload) + SAMPLE_OVERHEAD

    def expire(self, now: int) -> int:
        """Drop samples older than the duration, but never the newest; returns the bytes freed."""
        samples, horizon = self.samples, now - self.duration
        if not samples or samples[0].received > horizon:
            return 0
        if len(samples) > 2 and samples[1].received > horizon:  # usual at low rates: one sample expires
            return self.drop_oldest()
        freed = self._drop(bisect_right(samples, horizon, 0, len(samples) - 1, key=_RECEIVED))
        self.bytes -= freed
        return freed

    def _drop(self, count: int) -> int:
        """Drop the `count` oldest samples; returns the bytes freed."""
        pop = self.samples.popleft
        return sum([len(pop().payload) for _ in range(count)]) + SAMPLE_OVERHEAD * count

    def step_back(self, to: int) -> None:
        """Time continues at the earlier time `to`: forget all samples, as if none had ever arrived."""
        self.samples.clear()
        self.bytes = 0
        self._newest_evicted = NEVER

    def newest_first(self, after: int | None, until: int, now: int | None = None) -> Iterator[Sample]:
        """The samples of (after, until], newest first; all up to `until` if `after` is None.

        Excludes samples older than the duration at `now` (None: at `until`), except the newest of all.
        """
        horizon = (until if now is None else now) - self.duration
        for newer, sample in enumerate(reversed(self.samples)):
            if (after is not None and sample.time <= after) or (newer and sample.time <= horizon):
                return
            if sample.time <= until:
                yield sample


class ItemLane(Lane):
    """The items of one client on one stream with `items`: the items of a message share its payload."""

    __slots__ = ()

    def _update_capped(self) -> None:
        """Every sample goes through `insert`."""
        self.capped = True

    def size_of(self, sample: Sample) -> int:
        """See Lane."""
        return (sample.share if isinstance(sample, Item) else len(sample.payload)) + SAMPLE_OVERHEAD

    def _drop(self, count: int) -> int:
        """See Lane."""
        return sum(self.size_of(self.samples.popleft()) for _ in range(count))


class Buffer:
    """All lanes, and the cap on their total size."""

    def __init__(self, maximum_bytes: int) -> None:
        """`maximum_bytes` bounds the payloads and their overhead over all lanes."""
        self.maximum_bytes = maximum_bytes
        self.bytes = 0
        self._lanes: dict[str, dict[str, Lane]] = {}
        """By client and stream."""
        self.on_added: Callable[[Lane], None] = lambda lane: None
        """Called with each new lane."""
        self._evicted_before = 0
        """Samples evicted from lanes that no longer exist."""
        self.evictions = 0
        """Changes when samples leave before they expire: evicted by the cap over all lanes, or dropped with their
        lane."""

    def lane(self, client: str, stream: str) -> Lane | None:
        """The client's lane of the stream, if it has one."""
        lanes = self._lanes.get(client)
        return None if lanes is None else lanes.get(stream)

    def of(self, clients: Iterable[str]) -> Iterator[Lane]:
        """The lanes of these clients."""
        return (lane for client in clients for lane in self._lanes.get(client, {}).values())

    def add(self, lane: Lane) -> Lane:
        """Add the lane, unless its client and stream already have one; returns the lane in the buffer."""
        lanes = self._lanes.setdefault(lane.client, {})
        if lane.stream not in lanes:
            lanes[lane.stream] = lane
            self.on_added(lane)
        return lanes[lane.stream]

    def has_room(self, size: int) -> bool:
        """Whether an insertion of this size (bytes) evicts nothing."""
        return self.bytes + size <= self.maximum_bytes

    def grew(self, size: int) -> None:
        """Account for inserted bytes, and enforce the cap."""
        self.bytes += size
        if self.bytes > self.maximum_bytes:
            self.shrink()

    def expire(self, now: int) -> None:
        """Drop samples that are older than their lanes' durations."""
        for lanes in self._lanes.values():
            for lane in lanes.values():
                samples = lane.samples
                if samples and samples[0].received <= now - lane.duration:  # most lanes are idle
                    self.bytes -= lane.expire(now)

    def latest(self, client: str) -> int:
        """The greatest time of the client's samples on any stream; NEVER if it has none."""
        return max([lane.latest for lane in self._lanes.get(client, {}).values()], default=NEVER)

    def forget(self, client: str, streams: Collection[str] | None = None) -> None:
        """Drop all lanes of a client, or only those of some streams."""
        lanes = self._lanes.pop(client, {})
        for stream in list(lanes):
            if streams is None or stream in streams:
                self._drop(lanes.pop(stream))
        if lanes:
            self._lanes[client] = lanes

    def retain(self, streams: Collection[str]) -> None:
        """Keep the lanes of these streams only."""
        for client, lanes in list(self._lanes.items()):
            for stream in [stream for stream in lanes if stream not in streams]:
                self._drop(lanes.pop(stream))
            if not lanes:
                del self._lanes[client]

    def step_back(self, to: int) -> None:
        """Time continues at the earlier time `to`: forget all samples except latched ones; the lanes are kept."""
        for lane in self:
            lane.step_back(to)
        self.bytes = sum(lane.bytes for lane in self)

    @property
    def evicted(self) -> int:
        """Samples that a cap evicted before they expired."""
        return self._evicted_before + sum(lane.evicted for lane in self)

    def __iter__(self) -> Iterator[Lane]:
        return (lane for lanes in self._lanes.values() for lane in lanes.values())

    def _drop(self, lane: Lane) -> None:
        self.bytes -= lane.bytes
        self._evicted_before += lane.evicted
        self.evictions += 1

    def shrink(self) -> None:
        """Evict the oldest samples over all lanes; those of latched lanes only if nothing else is left."""
        self.evictions += 1
        self._shrink(latched=False)
        if self.bytes > self.maximum_bytes:
            self._shrink(latched=True)

    def _shrink(self, *, latched: bool) -> None:
        target = self.maximum_bytes - self.maximum_bytes // _SLACK
        heads = [
            (lane.samples[0].time, lane.client, lane.stream, lane)
            for lane in self
            if lane.samples and lane.latched is latched
        ]
        heapq.heapify(heads)
        while self.bytes > target and heads:
            lane = heads[0][-1]
            self.bytes -= lane.drop_oldest()
            lane.evicted += 1
            if lane.samples:
                heapq.heapreplace(heads, (lane.samples[0].time, lane.client, lane.stream, lane))
            else:
                heapq.heappop(heads)
