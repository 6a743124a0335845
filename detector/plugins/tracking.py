"""Matches two sets of points, and tracks points over time, to measure how long each has been present."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
