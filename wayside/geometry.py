"""Areas, lines and lanes, and where positions are with regard to them: for one position or many, with the same numbers.

Everything is addition, multiplication, division and square roots, which give the same bits on every processor.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from wayside import geodesy

Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]
Point = tuple[float, float]

FARTHEST: Final = 1e12
"""No frame reaches this far, in metres."""
_AT_ONCE: Final = 1 << 20
"""Maximum size of a matrix of positions and edges."""
_DOUBT: Final = 4e-16


class Arc(NamedTuple):
    """Positions with regard to a line; float64[n] each, metres."""

    along: Doubles
    """From the start of the line; before it negative, beyond the end greater than the length."""
    across: Doubles
    """To the left of the line; to the right negative."""
    distance: Doubles
    """To the nearest point of the line."""
    direction: Doubles
    """Of the line there, degrees counter-clockwise from the first axis, or from east."""


@dataclass(frozen=True, eq=False)
class Shape:
    """A named area, line or lane. Points are x and y in metres; where `geographic`, latitude and longitude in degrees.

    A lane is a line with a width, or an area with its centre line.
    """

    name: str
    geographic: bool
    rings: tuple[tuple[Point, ...], ...] = ()
    """The outlines of the area by the even-odd rule; a hole is an outline within another."""
    line: tuple[Point, ...] = ()
    width: float | None = None

    @cached_property
    def key(self) -> str:
        """Name and content in short: equal shapes have equal keys."""
        content = json.dumps([self.name, self.geographic, self.rings, self.line, self.width])
        return f"{self.name}#{hashlib.sha256(content.encode()).hexdigest()[:16]}"

    @property
    def fields(self) -> tuple[str, ...]:
        """What is known of a position with regard to it."""
        bounded = ("inside",) if self.rings or self.width is not None else ()
        return (*bounded, "distance", *(("along", "across", "heading") if self.line else ()))

    def allows(self, u: Doubles, v: Doubles) -> Bools:
        """Where (u, v) can be a position at all."""
        u_limit, v_limit = (90.0, 360.0) if self.geographic else (FARTHEST, FARTHEST)
        found: Bools = (np.abs(u) <= u_limit) & (np.abs(v) <= v_limit)
        return found

    def inside(self, u: Doubles, v: Doubles) -> Bools:
        """Whether positions lie inside, or on the edge. An area decides exactly; else the width of the lane does."""
        if self.rings:
            return self._in_rings(u, self._unrolled(v))
        found: Bools = self._beside(self.arc(u, v)) == 0
        return found

    def distance(self, u: Doubles, v: Doubles) -> Doubles:
        """Metres to the area or the lane, 0 inside; to a line that has neither width nor area, metres to the line."""
        if self.rings:
            x, y = self._metres(u, v)
            nearest = np.sqrt(np.minimum.reduce([_nearest(x, y, each).squares for each in self._outlines]))
            return np.where(self.inside(u, v), 0.0, nearest)
        arc = self.arc(u, v)
        return arc.distance if self.width is None else self._beside(arc)

    def arc(self, u: Doubles, v: Doubles) -> Arc:
        """Positions with regard to the line."""
        return _arc(*self._metres(u, v), self._segments)

    def _beside(self, arc: Arc) -> Doubles:
        """Metres to the lane of this width, 0 on it."""
        aside = np.maximum(np.abs(arc.across) - (self.width or 0.0) / 2, 0.0)
        beyond = np.maximum(np.maximum(-arc.along, arc.along - self._segments.length), 0.0)
        found: Doubles = np.sqrt(aside * aside + beyond * beyond)
        return found

    def _in_rings(self, u: Doubles, v: Doubles) -> Bools:
        found = np.zeros(len(u), bool)
        ax, ay, bx, by = self._edges
        for rows in _parts(len(u), len(ax)):
            x, y = u[rows, None], v[rows, None]
            left, right = (bx - ax) * (y - ay), (by - ay) * (x - ax)
            side = left - right
            near = (np.minimum(ay, by) <= y) & (y <= np.maximum(ay, by)) & (x <= np.maximum(ax, bx))
            doubtful = (near & (np.abs(side) <= _DOUBT * (np.abs(left) + np.abs(right)))).any(axis=1)
            crossed = near & ((ay > y) != (by > y)) & ((side > 0) == (by > ay))
            found[rows] = crossed.sum(axis=1) % 2 == 1
            for row in np.flatnonzero(doubtful).tolist():
                found[rows.start + row] = contains(self._unrolled_rings, (float(x[row, 0]), float(y[row, 0])))
        return found

    # Frames

    @cached_property
    def _origin(self) -> Point:
        return (self.rings[0] if self.rings else self.line)[0]

    @cached_property
    def _scale(self) -> Point:
        """Metres a degree of latitude and of longitude at the origin, on the ellipsoid."""
        return geodesy.degrees(self._origin[0])

    def _unrolled(self, v: Doubles) -> Doubles:
        """Longitudes as they follow on from the origin's."""
        if not self.geographic:
            return v
        away = v - self._origin[1]
        found: Doubles = v - 360.0 * np.round(away / 360.0)
        return found

    def _metres(self, u: Doubles, v: Doubles) -> tuple[Doubles, Doubles]:
        if not self.geographic:
            return u, v
        north, east = self._scale
        return (self._unrolled(v) - self._origin[1]) * east, (u - self._origin[0]) * north

    @cached_property
    def _unrolled_rings(self) -> tuple[tuple[Point, ...], ...]:
        return tuple(
            tuple((u, float(self._unrolled(np.array([v]))[0])) for u, v in ring) if self.geographic else ring
            for ring in self.rings
        )

    @cached_property
    def _edges(self) -> tuple[Doubles, Doubles, Doubles, Doubles]:
        edges = [
            (*here, *there)
            for ring in self._unrolled_rings
            for here, there in zip((ring[-1], *ring[:-1]), ring, strict=True)
        ]
        ax, ay, bx, by = np.array(edges, np.float64).T
        return ax, ay, bx, by

    @cached_property
    def _segments(self) -> _Segments:
        return self._way(self.line)

    @cached_property
    def _outlines(self) -> tuple[_Segments, ...]:
        return tuple(self._way((*ring, ring[0])) for ring in self.rings)

    def _way(self, points: Sequence[Point]) -> _Segments:
        u, v = np.array(points, np.float64).T
        x, y = self._metres(u, v)
        return _segments(x, y)


_SHAPES: WeakValueDictionary[str, Shape] = WeakValueDictionary()


def interned(shape: Shape) -> Shape:
    """The one shape of this key, by which `shape_of` finds it as long as somebody uses it."""
    return _SHAPES.setdefault(shape.key, shape)


def shape_of(key: str) -> Shape:
    """The shape of a key. Raises ValueError where nobody uses it any more."""
    try:
        return _SHAPES[key]
    except KeyError:
        raise ValueError(f"there is no place {key.partition('#')[0]} any more") from None


class _Segments(NamedTuple):
    """The segments of a line in metres; float64[segments] each."""

    x: Doubles
    y: Doubles
    dx: Doubles
    dy: Doubles
    squares: Doubles
    lengths: Doubles
    begins: Doubles
    """How far along the line each begins."""
    directions: Doubles
    """Degrees counter-clockwise."""
    length: float


def _segments(x: Doubles, y: Doubles) -> _Segments:
    dx, dy = np.diff(x), np.diff(y)
    some = (dx != 0) | (dy != 0)
    x, y, dx, dy = x[:-1][some], y[:-1][some], dx[some], dy[some]
    squares = dx * dx + dy * dy
    lengths = np.sqrt(squares)
    ends = np.cumsum(lengths)
    directions = [math.degrees(math.atan2(b, a)) for a, b in zip(dx.tolist(), dy.tolist(), strict=True)]
    return _Segments(x, y, dx, dy, squares, lengths, ends - lengths, np.array(directions), float(ends[-1]))


class _Nearest(NamedTuple):
    """The nearest point of a line to positions."""

    segment: NDArray[np.intp]
    part: Doubles
    """How far along the segment, 0 to 1 on it."""
    squares: Doubles
    """Of the distance."""


def _nearest(x: Doubles, y: Doubles, of: _Segments) -> _Nearest:
    found = _Nearest(np.zeros(len(x), np.intp), np.zeros(len(x)), np.zeros(len(x)))
    for rows in _parts(len(x), len(of.x)):
        px, py = x[rows, None] - of.x, y[rows, None] - of.y
        part = (px * of.dx + py * of.dy) / of.squares
        on = np.minimum(np.maximum(part, 0.0), 1.0)
        qx, qy = px - on * of.dx, py - on * of.dy
        squares = qx * qx + qy * qy
        best = np.argmin(squares, axis=1)
        at = np.arange(len(best)), best
        found.segment[rows], found.part[rows], found.squares[rows] = best, part[at], squares[at]
    return found


def _arc(x: Doubles, y: Doubles, of: _Segments) -> Arc:
    nearest = _nearest(x, y, of)
    segment, part = nearest.segment, nearest.part
    distance = np.sqrt(nearest.squares)
    last = len(of.x) - 1
    on = np.minimum(np.maximum(part, 0.0), 1.0)
    # The first and the last segment continue straight beyond the ends of the line.
    straight = (part == on) | ((segment == 0) & (part < 0)) | ((segment == last) & (part > 1))
    px, py = x - of.x[segment], y - of.y[segment]
    cross = of.dx[segment] * py - of.dy[segment] * px
    # At a corner the side is that of the bisector: of either segment alone it would be wrong behind a sharp one.
    ahead = part > 1
    other = np.minimum(np.maximum(np.where(ahead, segment + 1, segment - 1), 0), last)
    tx = of.dx[segment] / of.lengths[segment] + of.dx[other] / of.lengths[other]
    ty = of.dy[segment] / of.lengths[segment] + of.dy[other] / of.lengths[other]
    cx, cy = px - np.where(ahead, of.dx[segment], 0.0), py - np.where(ahead, of.dy[segment], 0.0)
    corner = np.where(tx * cy - ty * cx < 0, -distance, distance)
    along = of.begins[segment] + np.where(straight, part, on) * of.lengths[segment]
    across = np.where(straight, cross / of.lengths[segment], corner)
    return Arc(along, across, distance, of.directions[segment])


def _parts(rows: int, columns: int) -> Iterator[slice]:
    step = max(1, _AT_ONCE // max(columns, 1))
    return (slice(first, min(first + step, rows)) for first in range(0, rows, step))


# Exact decisions about single points


def contains(rings: Iterable[Sequence[Point]], point: Point) -> bool:
    """Whether the point lies inside the outlines by the even-odd rule, or on an edge.

    A ray along the first axis crosses the edges an odd number of times. Exact, so that edges belong to it.
    """
    x, y = point
    odd = False
    for corners in rings:
        ax, ay = corners[-1]
        for bx, by in corners:
            if min(ay, by) <= y <= max(ay, by) and x <= max(ax, bx):
                found = side((ax, ay), (bx, by), point)
                if found == 0 and min(ax, bx) <= x:
                    return True
                if (ay > y) != (by > y) and (found > 0) == (by > ay):
                    odd = not odd
            ax, ay = bx, by
    return odd


def side(a: Point, b: Point, point: Point) -> float:
    """Above 0 where the point lies left of the way from a to b, 0 on its line; exact by fractions in doubt."""
    (ax, ay), (bx, by), (x, y) = a, b, point
    left, right = (bx - ax) * (y - ay), (by - ay) * (x - ax)
    value = left - right
    if abs(value) > _DOUBT * (abs(left) + abs(right)) and math.isfinite(value):
        return value
    exact = (Fraction(bx) - Fraction(ax)) * (Fraction(y) - Fraction(ay)) - (Fraction(by) - Fraction(ay)) * (
        Fraction(x) - Fraction(ax)
    )
    return (exact > 0) - (exact < 0)


def crossing(ring: Sequence[Point]) -> tuple[int, int] | None:
    """Two edges of an outline that cross or touch, by their first corners; None where it is simple."""
    count = len(ring)
    edges = [*pairwise(ring), (ring[-1], ring[0])]
    for one, (a, b) in enumerate(edges):
        for other in range(one + 1, count):
            c, d = edges[other]
            beside = {(other - one) % count, (one - other) % count} & {1}
            if max(min(a[0], b[0]), min(c[0], d[0])) > min(max(a[0], b[0]), max(c[0], d[0])):
                continue
            if max(min(a[1], b[1]), min(c[1], d[1])) > min(max(a[1], b[1]), max(c[1], d[1])):
                continue
            sides = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
            if beside:
                if sides[:2] == (0, 0) and _fold(a, b, c, d):
                    return one, other
            elif sides[0] * sides[1] <= 0 and sides[2] * sides[3] <= 0:
                return one, other
    return None


def _fold(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the second of two edges on one line runs back over the first."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = a, b, c, d
    return (bx - ax) * (dx - cx) + (by - ay) * (dy - cy) < 0
