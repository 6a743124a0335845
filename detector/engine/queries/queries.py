"""The contents of the buffer at a tick, for plugins: decoded samples by client, stream, time and frame.

A view at a tick contains the samples up to its time, and never changes anything. `newest`, `last` and `between` use the
time at which a sample came in (the engine's time axis, see docs/concepts.md). Methods that compare data with data
(`nearest`, `pose`, `tuples`, `transform`) use the senders' stamps. All times are nanoseconds since the epoch.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple, Protocol

from detector.engine.buffering.buffer import Buffer, Lane
from detector.engine.buffering.clients import Clients, fresh_streams
from detector.engine.buffering.messages import Messages
from detector.engine.queries.geometry import Pose, pose_in
from detector.engine.queries.transforms import Transforms
from detector.engine.samples.sample import Sample
from wayside.expressions import UNKNOWN


class QueryError(ValueError):
    """A query is not valid; the text names the reason."""


class DecodedSample(NamedTuple):
    """One sample in the form that plugins receive."""

    client: str
    stream: str
    key: str
    """The full Zenoh key of the message."""
    time: int
    """Its time on the engine's time axis, in nanoseconds since the epoch."""
    stamp: int
    """The sender's time in nanoseconds since the epoch; the receive time if the message has none."""
    message: Any
    """Maps, lists, strings, booleans, None, bytes and doubles, as in expressions; for a stream with items, the client's
    item."""


class Queries(Protocol):
    """The buffer at one tick. `client=None` means all clients; samples that cannot be decoded are left out and counted.

    All raise QueryError for a stream that the Detector does not have.
    """

    @property
    def now(self) -> int:
        """The tick."""

    def clients(self) -> list[str]:
        """The known clients, sorted."""

    def streams(self, client: str) -> list[str]:
        """The client's streams that are not stale."""

    def newest(self, client: str | None, stream: str, *, frame: str | None = None) -> DecodedSample | None:
        """The sample with the newest time; with `frame`, only of those with this header.frame_id."""

    def last(self, client: str | None, stream: str, count: int, *, frame: str | None = None) -> list[DecodedSample]:
        """The newest `count` samples, oldest first."""

    def between(
        self, client: str | None, stream: str, after: int, until: int, *, frame: str | None = None
    ) -> list[DecodedSample]:
        """The samples of (after, until], oldest first; like windows, none from before a gap in time."""

    def nearest(self, client: str | None, stream: str, stamp: int, *, frame: str | None = None) -> DecodedSample | None:
        """The sample whose stamp is nearest; of two equally near, the earlier one."""

    def pose(self, client: str, stream: str, stamp: int, *, at: str = "") -> Pose | None:
        """The client's pose at that time, interpolated between the samples before and after (position linear,
        orientation slerp).

        None if there are no samples on both sides; at exactly the stamp of a sample, one is enough. `at` is the path to
        the pose in the message; without it, pose, pose.pose or transform.

        Raises:
            PoseError: the messages have no pose at that path.
        """

    def tuples(self, client: str, streams: Sequence[str], slop: int) -> list[tuple[DecodedSample, ...]]:
        """Samples of several streams that belong together, oldest first; `slop` is in nanoseconds.

        The first stream is the reference; see `matched`.
        """

    def transform(self, client: str, target: str, source: str, stamp: int | None = None) -> Pose:
        """The pose of frame `source` in frame `target`: it transforms points given in source into target.

        `stamp` None: the newest time for which all transforms between them are known.

        Raises:
            TransformError: a frame is unknown, the frames are not connected, or the time is beyond the transforms'
            stamps.
        """


class BufferQueries:
    """The queries over the engine's buffer; there is a new object for each tick."""

    def __init__(
        self,
        now: int,
        floor: int | None,
        buffer: Buffer,
        clients: Clients,
        messages: Messages,
        stale_after: Mapping[str, int | None],
        transforms: Transforms,
    ) -> None:
        """`floor` is the time of the last gap, `now` the tick; nanoseconds."""
        self._now = now
        self._floor = floor
        self._buffer = buffer
        self._clients = clients
        self._messages = messages
        self._stale_after = stale_after
        self._transforms = transforms
        self._by_stamp: dict[tuple[str, str], list[tuple[int, int, Sample]]] = {}

    @property
    def now(self) -> int:
        """The tick."""
        return self._now

    def clients(self) -> list[str]:
        """See Queries."""
        return list(self._clients)

    def streams(self, client: str) -> list[str]:
        """See Queries."""
        return fresh_streams(client, self._stale_after, self._buffer, self._now)

    def newest(self, client: str | None, stream: str, *, frame: str | None = None) -> DecodedSample | None:
        """See Queries."""
        return next(self._newest_first(client, stream, None, self._now, frame), None)

    def last(self, client: str | None, stream: str, count: int, *, frame: str | None = None) -> list[DecodedSample]:
        """See Queries."""
        found = list(islice(self._newest_first(client, stream, None, self._now, frame), max(count, 0)))
        return found[::-1]

    def between(
        self, client: str | None, stream: str, after: int, until: int, *, frame: str | None = None
    ) -> list[DecodedSample]:
        """See Queries."""
        if self._floor is not None:
            after = max(after, self._floor)
        return list(self._newest_first(client, stream, after, min(until, self._now), frame))[::-1]

    def nearest(self, client: str | None, stream: str, stamp: int, *, frame: str | None = None) -> DecodedSample | None:
        """See Queries."""
        best: DecodedSample | None = None
        for name in self._names(client):
            for of_client in self._nearest_of(name, stream, stamp, frame):
                if best is None or _distance(of_client, stamp) < _distance(best, stamp):
                    best = of_client
        return best

    def pose(self, client: str, stream: str, stamp: int, *, at: str = "") -> Pose | None:
        """See Queries."""
        samples = self._stamped(client, stream)
        after = bisect_right(samples, stamp, key=lambda each: each[0])
        before = self._decoded(client, stream, samples[after - 1]) if after else None
        if before is None:
            return None
        if before.stamp == stamp:
            return pose_in(before.message, at)
        following = self._decoded(client, stream, samples[after]) if after < len(samples) else None
        if following is None:
            return None
        share = (stamp - before.stamp) / (following.stamp - before.stamp)
        return pose_in(before.message, at).towards(pose_in(following.message, at), share)

    def tuples(self, client: str, streams: Sequence[str], slop: int) -> list[tuple[DecodedSample, ...]]:
        """See Queries."""
        if not streams:
            raise QueryError("tuples: name at least one stream")
        samples = [self._stamped(client, stream) for stream in streams]
        found = []
        for members in matched([[each[0] for each in of_stream] for of_stream in samples], slop):
            decoded = [
                self._decoded(client, stream, of_stream[index])
                for stream, of_stream, index in zip(streams, samples, members, strict=True)
            ]
            complete = [each for each in decoded if each is not None]
            if len(complete) == len(decoded):
                found.append(tuple(complete))
        return found

    def transform(self, client: str, target: str, source: str, stamp: int | None = None) -> Pose:
        """See Queries."""
        return self._transforms.lookup(client, target, source, stamp, self._now)

    def _names(self, client: str | None) -> list[str]:
        return list(self._clients) if client is None else [client]

    def _lane(self, client: str, stream: str) -> Lane | None:
        if stream not in self._stale_after:
            raise QueryError(f"the Detector has no stream {stream!r}; it has {', '.join(self._stale_after)}")
        return self._buffer.lane(client, stream)

    def _newest_first(
        self, client: str | None, stream: str, after: int | None, until: int, frame: str | None
    ) -> Iterator[DecodedSample]:
        """For several clients, merged by time; of equal times, the client with the greater name first."""
        names = self._names(client)
        lanes = [lane for name in names if (lane := self._lane(name, stream)) is not None]
        if len(lanes) == 1:
            yield from self._of_lane(lanes[0], after, until, frame)
            return
        streams = [self._of_lane(lane, after, until, frame) for lane in lanes]
        yield from heapq.merge(*streams, key=lambda sample: (sample.time, sample.client), reverse=True)

    def _of_lane(self, lane: Lane, after: int | None, until: int, frame: str | None) -> Iterator[DecodedSample]:
        for sample in lane.newest_first(after, until, self._now):
            stamp = self._messages.stamp(lane.stream, sample)
            decoded = None if stamp is None else self._decoded(lane.client, lane.stream, (stamp, 0, sample))
            if decoded is not None and (frame is None or frame_of(decoded.message) == frame):
                yield decoded

    def _stamped(self, client: str, stream: str) -> list[tuple[int, int, Sample]]:
        """The lane's samples with their stamps, sorted by stamp, then by time; computed once a tick."""
        known = self._by_stamp.get((client, stream))
        if known is None:
            lane = self._lane(client, stream)
            samples = [] if lane is None else list(lane.newest_first(None, self._now))[::-1]
            known = []
            for index, sample in enumerate(samples):
                stamp = self._messages.stamp(stream, sample)
                if stamp is not None:
                    known.append((stamp, index, sample))
            known.sort(key=lambda each: each[:2])
            self._by_stamp[client, stream] = known
        return known

    def _nearest_of(self, client: str, stream: str, stamp: int, frame: str | None) -> Iterator[DecodedSample]:
        samples = self._stamped(client, stream)
        if frame is not None:
            of_frame: Callable[[tuple[int, int, Sample]], bool] = lambda each: (  # noqa: E731  a filter, named
                (decoded := self._decoded(client, stream, each)) is not None and frame_of(decoded.message) == frame
            )
            samples = list(filter(of_frame, samples))
        if samples:
            decoded = self._decoded(client, stream, samples[nearest_index([each[0] for each in samples], stamp)])
            if decoded is not None:
                yield decoded

    def _decoded(self, client: str, stream: str, stamped: tuple[int, int, Sample]) -> DecodedSample | None:
        stamp, _, sample = stamped
        message = self._messages.content(stream, sample)
        if message is UNKNOWN:
            return None
        return DecodedSample(client, stream, sample.key, sample.time, stamp, message)


def frame_of(message: Any) -> str | None:
    """header.frame_id, if the message has one."""
    header = message.get("header") if isinstance(message, dict) else None
    frame = header.get("frame_id") if isinstance(header, dict) else None
    return frame if isinstance(frame, str) else None


def _distance(sample: DecodedSample, stamp: int) -> tuple[int, int]:
    return abs(sample.stamp - stamp), sample.stamp


def matched(stamps: Sequence[Sequence[int]], slop: int) -> list[tuple[int, ...]]:
    """The tuples of samples with about the same stamp, as indices into each stream's stamps, in order of the reference.

    The first stream is the reference. A tuple is one sample of each stream such that

    1. each is the nearest of its stream to the reference sample by stamp, and the reference sample is the nearest of
       its own stream to each of them (of two equally near ones, that with the smaller stamp; of equal ones, the first),
    2. the stamps of all of them lie within `slop` of each other.

    So a sample is in at most one tuple, and the result depends neither on the order of arrival nor on where the search
    begins.

    Args:
        stamps: for each stream the stamps of its samples in ascending order; nanoseconds. The first stream is the
            reference.
        slop: maximum distance between the stamps of a tuple, in nanoseconds.
    """
    reference, *others = stamps
    found = []
    for index, stamp in enumerate(reference):
        members = [index]
        for other in others:
            if not other:
                return []
            near = nearest_index(other, stamp)
            if nearest_index(reference, other[near]) != index:
                break
            members.append(near)
        else:
            times = [of[member] for of, member in zip(stamps, members, strict=True)]
            if max(times) - min(times) <= slop:
                found.append(tuple(members))
    return found


def nearest_index(stamps: Sequence[int], time: int) -> int:
    """The index of the stamp nearest to `time`; of two equally near ones the smaller, of equal ones the first.

    `stamps` is ascending and not empty.
    """
    after = bisect_left(stamps, time)
    if after == 0:
        return 0
    before = stamps[after - 1]
    if after < len(stamps) and stamps[after] - time < time - before:
        return after
    return bisect_left(stamps, before)
