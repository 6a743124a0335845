"""Makes the lanes of each stream, within the limits that the Detector sets.

In the lanes of a latched stream the last sample stays valid at any age, until it is replaced. The topic of a sample
is its key; for transforms (a /tf_static that several publishers share) the key and the frames. The newest sample of
each topic is kept beyond the duration; caps evict it last of all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping

from msgspec.structs import replace

from detector.engine.buffering.buffer import NEVER, ItemLane, Lane, bytes_of
from detector.engine.samples.sample import DecodeError, Decoder, Sample
from wayside.api import Detector
from wayside.api.stream import Stream

Topic = Callable[[str, bytes], Hashable]
"""The topic of a sample with that key and payload: a newer sample of the same topic replaces it."""


def by_key(key: str, payload: bytes) -> Hashable:
    """The topic is the key."""
    return key


def by_key_and_frames(decoder: Decoder) -> Topic:
    """The topic of transforms is the key and their child frames; of payloads that cannot be read, the key."""

    def topic(key: str, payload: bytes) -> Hashable:
        try:
            return key, frozenset(each["child_frame_id"] for each in decoder.decode(payload)["transforms"])
        except DecodeError:
            return key

    return topic


class LatchedLane(Lane):
    """The samples of one client on one latched stream. Not optimised: such streams are rare and slow."""

    __slots__ = ("_topic", "_topics")

    latched = True

    def __init__(
        self,
        client: str,
        stream: str,
        duration: int,
        maximum_bytes: int | None = None,
        maximum_count: int | None = None,
        *,
        topic: Topic,
    ) -> None:
        super().__init__(client, stream, duration, maximum_bytes, maximum_count)
        self._topic = topic
        self._topics: dict[Sample, Hashable] = {}
        """The topics of samples, computed on first use; equal samples have equal topics."""

    def _update_capped(self) -> None:
        """Every sample goes through `insert`."""
        self.capped = True

    def drop_oldest(self) -> int:
        """See Lane."""
        self._topics.pop(self.samples[0], None)
        return super().drop_oldest()

    def expire(self, now: int) -> int:
        """Drop replaced samples that are older than the duration; returns the bytes freed."""
        horizon = now - self.duration
        if not self.samples or self.samples[0].time > horizon:
            return 0
        newest = {self._topic_of(sample): sample for sample in self.samples}
        return self._keep([s for s in self.samples if s.time > horizon or newest[self._topic_of(s)] is s])

    def newest_first(self, after: int | None, until: int, now: int | None = None) -> Iterator[Sample]:
        """See Lane; excludes replaced samples that are older than the duration."""
        horizon = (until if now is None else now) - self.duration
        replaced: set[Hashable] = set()
        for sample in reversed(self.samples):
            if after is not None and sample.time <= after:
                return
            topic = self._topic_of(sample)
            if sample.time <= until and (sample.time > horizon or topic not in replaced):
                yield sample
            replaced.add(topic)

    def step_back(self, to: int) -> None:
        """Time continues at the earlier time `to`: samples stay valid; newer times become `to`."""
        self._keep([_not_after(sample, to) for sample in self.samples])
        self._newest_evicted = NEVER

    def _topic_of(self, sample: Sample) -> Hashable:
        """The topic of the sample."""
        if sample not in self._topics:
            self._topics[sample] = self._topic(sample.key, sample.payload)
        return self._topics[sample]

    def _keep(self, samples: list[Sample]) -> int:
        """Keep only these samples; returns the bytes freed."""
        before = self.bytes
        self.samples = deque(samples)
        self._topics = {sample: self._topic_of(sample) for sample in samples}
        self.bytes = bytes_of(samples)
        return before - self.bytes


def _not_after(sample: Sample, time: int) -> Sample:
    if sample.time <= time:
        return sample
    moved: Sample = replace(sample, received=time)
    return moved


class LaneMaker:
    """Makes the lanes of one stream."""

    def __init__(self, stream: Stream, duration: int, topic: Topic | None) -> None:
        """`duration` is in nanoseconds; `topic` is given for a latched stream."""
        maximum = stream.buffer.bytes
        self._stream = stream.name
        self._limits = duration, None if maximum is None else maximum.bytes, stream.buffer.count
        self._topic = topic
        self._of_items = stream.items is not None

    def lane(self, client: str) -> Lane:
        """A new, empty lane of the client."""
        if self._topic is None:
            return (ItemLane if self._of_items else Lane)(client, self._stream, *self._limits)
        return LatchedLane(client, self._stream, *self._limits, topic=self._topic)

    def limit(self, lane: Lane) -> None:
        """Apply the current limits to an existing lane."""
        lane.limit(*self._limits)


def lane_makers(detector: Detector, decoders: Mapping[str, Decoder]) -> dict[str, LaneMaker]:
    """A lane maker for each stream of the Detector; `decoders` has a decoder for each stream."""
    topics = latched_topics(detector, decoders)
    return {
        stream.name: LaneMaker(stream, detector.spec.buffer_duration_ns(stream), topics.get(stream.name))
        for stream in detector.spec.streams
    }


def latched_topics(detector: Detector, decoders: Mapping[str, Decoder]) -> dict[str, Topic]:
    """For each latched stream of the Detector, the function that returns the topic of a sample."""
    return {
        stream.name: by_key_and_frames(decoders[stream.name]) if stream.carries_transforms else by_key
        for stream in detector.spec.streams
        if stream.latched
    }
