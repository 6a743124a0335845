"""The road network: junctions joined by straight and curved roads, each with a speed that suits it.

Everything is made of *segments*: the right-hand lane of a road in one direction, and the connecting curve from one
lane to another across a junction. A route is a chain of segments, so a vehicle never jumps and never turns on the spot.

Lengths are metres in the frame "map" (x to the east, y to the north), speeds metres per second, angles radians.

            nw ─────────────────────────── ne
          ╱  │                              │  ╲
        ╱   rn                              │    ╲
       w ─ rw  re ───────────────────────── e ── ee      the ring (rw rn re rs) encloses the old town
        ╲   rs                              │    ╱
          ╲  │                              │  ╱
            sw ─────────────────────────── se
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LANE_OFFSET = 1.75
"""How far a lane's middle lies to the right of the road's middle."""
TURN_ROOM = 18.0
"""How far from the junction's middle a lane ends and the connecting curve begins."""
TURN_ACCELERATION = 3.0
"""The sideways acceleration in m/s² that drivers accept when they turn at a junction."""
SPACING = 1.0
"""About how far apart the points of a segment are."""

RING_RADIUS = 110.0
BYPASS_RADIUS = 360.0

JUNCTIONS: dict[str, tuple[float, float]] = {
    "rw": (-440.0, 0.0),
    "rn": (-330.0, 110.0),
    "re": (-220.0, 0.0),
    "rs": (-330.0, -110.0),
    "e": (330.0, 0.0),
    "w": (-690.0, 0.0),
    "ee": (690.0, 0.0),
    "nw": (-330.0, 360.0),
    "sw": (-330.0, -360.0),
    "ne": (330.0, 360.0),
    "se": (330.0, -360.0),
}


@dataclass(frozen=True, slots=True)
class Road:
    """A road between two junctions; with a centre it is the arc around it, the shorter way."""

    start: str
    end: str
    speed: float
    centre: tuple[float, float] | None = None

    def points(self) -> Floats:
        """The road's middle from start to end, shape (n, 2)."""
        start, end = np.array(JUNCTIONS[self.start]), np.array(JUNCTIONS[self.end])
        if self.centre is None:
            count = max(2, round(float(np.hypot(*(end - start))) / SPACING) + 1)
            return np.linspace(start, end, count)
        middle = np.array(self.centre)
        radius = float(np.hypot(*(start - middle)))
        first, last = (math.atan2(*(point - middle)[::-1]) for point in (start, end))
        sweep = math.remainder(last - first, math.tau)
        angles = np.linspace(first, first + sweep, max(2, round(abs(sweep) * radius / SPACING) + 1))
        return middle + radius * np.column_stack([np.cos(angles), np.sin(angles)])


RING = ("rw", "rn", "re", "rs")
"""The ring's junctions, clockwise."""

_OLD_TOWN, _WEST_BYPASS, _EAST_BYPASS = (-330.0, 0.0), (-330.0, 0.0), (330.0, 0.0)

ROADS: tuple[Road, ...] = (
    *(Road(a, b, 21.0, _OLD_TOWN) for a, b in zip(RING, RING[1:] + RING[:1], strict=True)),
    Road("re", "e", 27.0),
    Road("w", "rw", 20.0),
    Road("e", "ee", 22.0),
    Road("rn", "nw", 17.0),
    Road("rs", "sw", 17.0),
    Road("e", "ne", 17.0),
    Road("e", "se", 17.0),
    Road("nw", "ne", 27.0),
    Road("sw", "se", 27.0),
    Road("w", "nw", 28.0, _WEST_BYPASS),
    Road("w", "sw", 28.0, _WEST_BYPASS),
    Road("ee", "ne", 28.0, _EAST_BYPASS),
    Road("ee", "se", 28.0, _EAST_BYPASS),
)

Lane = tuple[str, str]
"""A road in one direction: from junction, to junction."""


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A piece of a route: points of shape (n, 2), and the speed at which one drives it."""

    points: Floats
    speed: float
    length: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "length", float(np.hypot(*np.diff(self.points, axis=0).T).sum()))


@cache
def lanes() -> dict[Lane, Segment]:
    """The lanes of all roads in both directions, without the room that turns take at their ends."""
    found: dict[Lane, Segment] = {}
    for road in ROADS:
        middle = road.points()
        found[road.start, road.end] = Segment(_lane(middle), road.speed)
        found[road.end, road.start] = Segment(_lane(middle[::-1]), road.speed)
    return found


@cache
def choices(lane: Lane) -> tuple[tuple[Lane, bool], ...]:
    """The lanes that follow a lane's end, in a fixed order, and whether each is straight ahead. No U-turns."""
    here = lanes()[lane]
    onward = []
    for follower, segment in sorted(lanes().items()):
        if follower[0] == lane[1] and follower[1] != lane[0]:
            turn = math.remainder(_heading(segment.points[:2]) - _heading(here.points[-2:]), math.tau)
            onward.append((follower, abs(turn) < math.radians(40)))
    return tuple(onward)


@cache
def connection(lane: Lane, follower: Lane) -> Segment:
    """The curve across the junction from one lane to the next: a quadratic Bézier that is tangent to both."""
    before, after = lanes()[lane], lanes()[follower]
    start, end = before.points[-1], after.points[0]
    control = _meeting(start, start - before.points[-2], end, after.points[1] - end)
    speed = min(before.speed, after.speed)
    smooth = (follower, True) in choices(lane)
    if control is None:
        return Segment(np.linspace(start, end, max(2, round(float(np.hypot(*(end - start))) / SPACING) + 1)), speed)
    share = np.linspace(0.0, 1.0, 41)[:, None]
    points = (1 - share) ** 2 * start + 2 * share * (1 - share) * control + share**2 * end
    return Segment(points, speed if smooth else min(speed, math.sqrt(TURN_ACCELERATION * _tightest_radius(points))))


def _lane(middle: Floats) -> Floats:
    along = np.gradient(middle, axis=0)
    along /= np.hypot(*along.T)[:, None]
    shifted = middle + LANE_OFFSET * np.column_stack([along[:, 1], -along[:, 0]])
    room = round(TURN_ROOM / SPACING)
    return shifted[room:-room]


def _heading(two_points: Floats) -> float:
    dx, dy = two_points[1] - two_points[0]
    return math.atan2(dy, dx)


def _meeting(start: Floats, ahead: Floats, end: Floats, onward: Floats) -> Floats | None:
    """Where the tangents meet between the two ends; None where the way is as good as straight."""
    cross = float(ahead[0] * onward[1] - ahead[1] * onward[0])
    lengths = float(np.hypot(*ahead) * np.hypot(*onward))
    if abs(cross) < math.sin(math.radians(0.3)) * lengths:
        return None
    gap = end - start
    share = float(gap[0] * onward[1] - gap[1] * onward[0]) / cross
    return start + share * ahead


def _tightest_radius(points: Floats) -> float:
    steps = np.diff(points, axis=0)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    lengths = np.hypot(*steps.T)
    bends = np.abs(np.diff(headings)) / ((lengths[:-1] + lengths[1:]) / 2)
    return float(1 / max(bends.max(), 1e-6))
