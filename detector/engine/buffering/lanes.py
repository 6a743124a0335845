"""Makes the lanes of each stream, within the limits that the Detector sets."""

from __future__ import annotations

from collections.abc import Mapping

from detector.engine.buffering.buffer import ItemLane, Lane
from detector.engine.buffering.latched import LatchedLane, Topic, by_key, by_key_and_frames
from detector.engine.samples.sample import Decoder
from wayside.api import Detector
from wayside.api.stream import Stream


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
    """One for each stream of the Detector; `decoders` has one for each as well."""
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
