"""Follows points from one moment to the next, to measure how long each has been there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from detector.plugins.assignment import Point, assigned


@dataclass(slots=True)
class TrackedPoint:
    """A point that is followed. Times are nanoseconds."""

    place: Point
    since: int
    last: int


class Tracks:
    """The points that are there, and were there before."""

    def __init__(self, within: float, speed: float, gap: int) -> None:
        """A point is the same as one before at most `within` metres, and `speed` m/s times the time between, away.

        One that is missing for `gap` nanoseconds starts over; with 0, one that is missing once.
        """
        self._within = within
        self._speed = speed
        self._gap = gap
        self._tracks: list[TrackedPoint] = []

    def follow(self, points: Sequence[Point], time: int) -> None:
        """These are the points at that time (ns), which is later than the one before."""
        tracks = self._tracks
        elapsed = max((time - track.last for track in tracks), default=0) / 1e9
        same = assigned([track.place for track in tracks], points, self._within + self._speed * elapsed)
        for index, point in same.items():
            tracks[index].place, tracks[index].last = points[point], time
        new = set(range(len(points))) - set(same.values())
        self._tracks = [track for track in tracks if track.last == time or time - track.last < self._gap]
        self._tracks += [TrackedPoint(points[index], time, time) for index in sorted(new)]

    def lasting(self, time: int, least: int) -> list[TrackedPoint]:
        """Those that are there at that time and have been for at least this many nanoseconds, oldest first."""
        return sorted(
            (track for track in self._tracks if track.last == time and time - track.since >= least),
            key=lambda track: (track.since, track.place),
        )
