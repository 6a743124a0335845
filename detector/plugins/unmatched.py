"""Objects of one list without a counterpart in another: one of two perception systems detects them and the other does
not.

The two lists belong to one client, or to the two clients of a pair. Samples with about the same stamp are compared: the
objects are transformed into one frame, matched by position (as many pairs within the gate as possible, and the nearest
of these), and the remaining ones are tracked over time. The signal is the list of objects that have remained unmatched
for long enough; a rule uses e.g. `when: size(unmatched) > 0`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from detector.engine.queries.geometry import NO_MOTION, Pose
from detector.engine.queries.queries import DecodedSample, Queries, frame_of, matched
from detector.engine.queries.transforms import TransformError
from detector.plugins.base import Plugin, PluginParameters, PluginSubject, Seconds, StreamName
from wayside.expressions import Value

Point = tuple[float, float]
"""Metres."""


def warm_up() -> None:
    """Load the dependencies of `assigned`, which takes a second or two."""
    import scipy.optimize  # noqa: F401, PLC0415  not at the top: checking a rule does not need it


def assigned(first: Sequence[Point], second: Sequence[Point], gate: float) -> dict[int, int]:
    """From indices of the first to indices of the second, each used at most once, at most `gate` metres apart.

    Of all assignments with the greatest number of pairs, one with the smallest sum of distances.
    """
    if not first or not second:
        return {}
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  see warm_up

    distances = np.array([[math.dist(a, b) for b in second] for a in first])
    within = distances <= gate
    # More expensive than all pairs within the gate together, so it is only used if no pair is left.
    beyond = (gate + 1.0) * (min(len(first), len(second)) + 1)
    rows, columns = linear_sum_assignment(np.where(within, distances, beyond))
    return {int(row): int(column) for row, column in zip(rows, columns, strict=True) if within[row, column]}


@dataclass(slots=True)
class TrackedPoint:
    """A tracked point. Times are nanoseconds."""

    place: Point
    since: int
    last: int


class Tracks:
    """The points that are present, or were present recently."""

    def __init__(self, within: float, speed: float, gap: int) -> None:
        """A point matches an earlier one at a distance of at most `within` metres plus `speed` m/s times the time
        between.

        A point that is missing for `gap` nanoseconds starts over; with 0, if it is missing once.
        """
        self._within = within
        self._speed = speed
        self._gap = gap
        self._tracks: list[TrackedPoint] = []

    def follow(self, points: Sequence[Point], time: int) -> None:
        """The points at that time (ns), which is later than the previous one."""
        tracks = self._tracks
        elapsed = max((time - track.last for track in tracks), default=0) / 1e9
        same = assigned([track.place for track in tracks], points, self._within + self._speed * elapsed)
        for index, point in same.items():
            tracks[index].place, tracks[index].last = points[point], time
        new = set(range(len(points))) - set(same.values())
        self._tracks = [track for track in tracks if track.last == time or time - track.last < self._gap]
        self._tracks += [TrackedPoint(points[index], time, time) for index in sorted(new)]

    def lasting(self, time: int, least: int) -> list[TrackedPoint]:
        """The points present at that time for at least this many nanoseconds, oldest first."""
        return sorted(
            (track for track in self._tracks if track.last == time and time - track.since >= least),
            key=lambda track: (track.since, track.place),
        )


_SAMPLES = 100
"""Number of samples of each list that are compared, from the newest."""

_LATE = 1_000_000_000
"""Nanoseconds for which the last comparison stays valid, while the transforms of newer samples are unknown."""

_OBJECTS = 500
"""Maximum length of a list; matching takes cubic time."""

Metres = Annotated[float, Field(gt=0, le=10_000)]


class PoseStream(PluginParameters):
    """The stream with the client's pose in the common frame."""

    stream: StreamName
    at: str = ""
    """The path to the pose in the message; without it pose, pose.pose or transform."""


class ObjectList(PluginParameters):
    """The stream with a list of objects, and the frame of its positions."""

    stream: StreamName
    list: str = "objects"
    """The path to the list in the message, such as `objects` or `perception.tracks`."""
    x: str = "x"
    y: str = "y"
    """The paths to the position in an object, in metres."""
    frame: str | None = None
    """The common frame: tf transforms positions from the message's header.frame_id into it, at the message's stamp."""
    pose: PoseStream | None = None
    """Instead of tf: positions are relative to the client's pose."""

    @model_validator(mode="after")
    def _one_way(self) -> ObjectList:
        if self.frame is not None and self.pose is not None:
            raise ValueError(
                "give frame (with tf) or pose (with a stream of poses), not both; give neither if the objects are "
                "already in a common frame"
            )
        return self


class UnmatchedParameters(PluginParameters):
    """The lists to compare, and how."""

    objects: ObjectList
    counterparts: ObjectList | None = None
    """Default: the same as objects, which is useful for a pair."""
    of: Literal["a", "b"] = "a"
    """In a pairs scope: whose objects are searched for among the other's."""
    within: Metres = 2.0
    """The gate: maximum distance between an object and its counterpart, in metres."""
    slop: Seconds = 0.1
    """Maximum difference between the stamps of compared samples."""
    persist: Seconds = 1.0
    """How long an object must be without a counterpart."""
    gap: Seconds = 0.0
    """How long it may be invisible, or matched, in between."""
    speed: Annotated[float, Field(ge=0, le=1000)] = 15.0
    """Maximum speed of objects in m/s: an object farther away is a different one."""


class UnmatchedObjects(Plugin[UnmatchedParameters]):
    """Objects of a list without a counterpart: a list of {x, y, seconds} in the common frame, oldest first."""

    Parameters = UnmatchedParameters

    def __init__(self, parameters: UnmatchedParameters, subject: PluginSubject) -> None:
        super().__init__(parameters, subject)
        self._tracks = Tracks(parameters.within, parameters.speed, round(parameters.gap * 1e9))
        self._last: int | None = None
        """The stamp of the objects that were last compared."""

    @classmethod
    def warm_up(cls) -> None:
        """Matching needs scipy."""
        warm_up()

    def value(self, queries: Queries, clients: tuple[str, ...]) -> Value:
        """None until two samples could be compared, and if one of the streams is stale."""
        if len(clients) > 2:
            raise ValueError(f"it compares one or two clients, not {len(clients)}: use it in a client or pairs scope")
        parameters = self.parameters
        seer, other = (clients[0], clients[-1]) if parameters.of == "a" else (clients[-1], clients[0])
        theirs = parameters.counterparts or parameters.objects
        if parameters.objects.stream not in queries.streams(seer) or theirs.stream not in queries.streams(other):
            return None
        objects = _by_stamp(queries.last(seer, parameters.objects.stream, _SAMPLES))
        counterparts = _by_stamp(queries.last(other, theirs.stream, _SAMPLES))
        stamps = [[sample.stamp for sample in objects], [sample.stamp for sample in counterparts]]
        error: TransformError | None = None
        newest = 0
        for mine, its in matched(stamps, round(parameters.slop * 1e9)):
            newest = objects[mine].stamp
            if self._last is None or newest > self._last:
                try:
                    self._compare(queries, parameters.objects, objects[mine], theirs, counterparts[its])
                except TransformError as now_unknown:
                    error = now_unknown  # it may still come
        if error is not None and (self._last is None or newest - self._last > _LATE):
            raise error
        if self._last is None:
            return None
        lasting = self._tracks.lasting(self._last, round(parameters.persist * 1e9))
        return [
            {"x": track.place[0], "y": track.place[1], "seconds": (self._last - track.since) / 1e9} for track in lasting
        ]

    def _compare(
        self, queries: Queries, mine: ObjectList, objects: DecodedSample, theirs: ObjectList, others: DecodedSample
    ) -> None:
        """Track the objects of one sample without a counterpart in the other. Raises TransformError."""
        points = _points(mine, objects, _frame(queries, mine, objects))
        counterparts = _points(theirs, others, _frame(queries, theirs, others))
        found = assigned(points, counterparts, self.parameters.within)
        self._tracks.follow([point for index, point in enumerate(points) if index not in found], objects.stamp)
        self._last = objects.stamp


def _by_stamp(samples: list[DecodedSample]) -> list[DecodedSample]:
    return sorted(samples, key=lambda sample: sample.stamp)


def _frame(queries: Queries, of: ObjectList, sample: DecodedSample) -> Pose:
    """The transform of the list's positions into the common frame, at the sample's stamp. Raises TransformError."""
    if of.pose is not None:
        pose = queries.pose(sample.client, of.pose.stream, sample.stamp, at=of.pose.at)
        if pose is None:
            raise TransformError(f"stream {of.pose.stream} of {sample.client} has no poses around {sample.stamp} ns")
        return pose
    if of.frame is None:
        return NO_MOTION
    source = frame_of(sample.message)
    if source is None:
        raise ValueError(
            f"a message of stream {of.stream} has no header.frame_id, which is needed with frame: {of.frame}"
        )
    return queries.transform(sample.client, of.frame, source, sample.stamp)


def _points(of: ObjectList, sample: DecodedSample, frame: Pose) -> list[Point]:
    """The positions of the objects in the common frame; objects without a position are left out."""
    objects = _at(sample.message, of.list)
    if not isinstance(objects, list):
        raise ValueError(f"a message of stream {of.stream} has no list at {of.list!r}")
    if len(objects) > _OBJECTS:
        raise ValueError(f"a message of stream {of.stream} has {len(objects)} objects; at most {_OBJECTS} are compared")
    places = ((_at(each, of.x), _at(each, of.y)) for each in objects)
    return [frame.apply((x, y, 0.0))[:2] for x, y in places if _is_place(x) and _is_place(y)]


def _is_place(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and math.isfinite(value)


def _at(message: Any, path: str) -> Any:
    here = message
    for name in path.split("."):
        here = here.get(name) if isinstance(here, dict) else None
    return here
