"""Positions with regard to areas, lines and lanes: for one position or many, with the same numbers.

Everything is addition, multiplication, division and square roots, which give the same bits on every processor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Final, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from wayside.geo import geodesy
from wayside.geo.geometry import DOUBT, FARTHEST, Point, Shape, contains, shape_of

Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]

_AT_ONCE: Final = 1 << 20
"""Maximum size of a matrix of positions and edges."""


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


class Positions:
    """Positions with regard to one shape. Columns are float64[n]."""

    def __init__(self, shape: Shape) -> None:
        """It keeps what it needs of the shape, and not the shape."""
        self._geographic, self._width = shape.geographic, shape.width
        self._rings, self._line = shape.rings, shape.line

    def allows(self, u: Doubles, v: Doubles, *headings: Doubles) -> Bools:
        """Where (u, v) can be a position at all, and the heading is finite."""
        u_limit, v_limit = (90.0, 360.0) if self._geographic else (FARTHEST, FARTHEST)
        found: Bools = (np.abs(u) <= u_limit) & (np.abs(v) <= v_limit)
        for each in headings:
            found = found & np.isfinite(each)
        return found

    def inside(self, u: Doubles, v: Doubles) -> Bools:
        """Whether positions lie inside, or on the edge. An area decides exactly; else the width of the lane does."""
        if self._rings:
            return self._in_rings(u, self._unrolled(v))
        found: Bools = self._beside(self.arc(u, v)) == 0
        return found

    def distance(self, u: Doubles, v: Doubles) -> Doubles:
        """Metres to the area or the lane, 0 inside; to a line that has neither width nor area, metres to the line."""
        if self._rings:
            x, y = self._metres(u, v)
            nearest = np.sqrt(np.minimum.reduce([_nearest(x, y, each).squares for each in self._outlines]))
            return np.where(self.inside(u, v), 0.0, nearest)
        arc = self.arc(u, v)
        return arc.distance if self._width is None else self._beside(arc)

    def arc(self, u: Doubles, v: Doubles) -> Arc:
        """Positions with regard to the line."""
        return _arc(*self._metres(u, v), self._segments)

    def _beside(self, arc: Arc) -> Doubles:
        """Metres to the lane of this width, 0 on it."""
        aside = np.maximum(np.abs(arc.across) - (self._width or 0.0) / 2, 0.0)
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
            doubtful = (near & (np.abs(side) <= DOUBT * (np.abs(left) + np.abs(right)))).any(axis=1)
            crossed = near & ((ay > y) != (by > y)) & ((side > 0) == (by > ay))
            found[rows] = crossed.sum(axis=1) % 2 == 1
            for row in np.flatnonzero(doubtful).tolist():
                found[rows.start + row] = contains(self._unrolled_rings, (float(x[row, 0]), float(y[row, 0])))
        return found

    # Frames

    @cached_property
    def _origin(self) -> Point:
        return (self._rings[0] if self._rings else self._line)[0]

    @cached_property
    def _scale(self) -> Point:
        """Metres a degree of latitude and of longitude at the origin, on the ellipsoid."""
        return geodesy.degrees(self._origin[0])

    def _unrolled(self, v: Doubles) -> Doubles:
        """Longitudes as they follow on from the origin's."""
        if not self._geographic:
            return v
        away = v - self._origin[1]
        found: Doubles = v - 360.0 * np.round(away / 360.0)
        return found

    def _metres(self, u: Doubles, v: Doubles) -> tuple[Doubles, Doubles]:
        if not self._geographic:
            return u, v
        north, east = self._scale
        return (self._unrolled(v) - self._origin[1]) * east, (u - self._origin[0]) * north

    @cached_property
    def _unrolled_rings(self) -> tuple[tuple[Point, ...], ...]:
        return tuple(
            tuple((u, float(self._unrolled(np.array([v]))[0])) for u, v in ring) if self._geographic else ring
            for ring in self._rings
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
        return self._way(self._line)

    @cached_property
    def _outlines(self) -> tuple[_Segments, ...]:
        return tuple(self._way((*ring, ring[0])) for ring in self._rings)

    def _way(self, points: Sequence[Point]) -> _Segments:
        u, v = np.array(points, np.float64).T
        x, y = self._metres(u, v)
        return _segments(x, y)


_KNOWN: WeakKeyDictionary[Shape, Positions] = WeakKeyDictionary()


def positions_at(shape: Shape) -> Positions:
    """Positions with regard to the shape, prepared once."""
    found = _KNOWN.get(shape)
    if found is None:
        found = _KNOWN[shape] = Positions(shape)
    return found


def turn(start: Doubles, end: Doubles) -> Doubles:
    """The turn from one direction to another, degrees in (-180, 180], positive to the left."""
    by = np.remainder(end - start, 360.0)
    return np.where(by > 180.0, by - 360.0, by)


AT: Final[Mapping[str, Callable[..., Doubles]]] = {
    "at_inside": lambda at, u, v: at.inside(u, v).astype(np.float64),
    "at_distance": Positions.distance,
    "at_along": lambda at, u, v: at.arc(u, v).along,
    "at_across": lambda at, u, v: at.arc(u, v).across,
    "at_heading": lambda at, u, v, heading: turn(at.arc(u, v).direction, heading),
}
"""The functions that the fields of `at(position, place)` become, by name, of `Positions` and columns."""


def at_one(name: str, key: str, *numbers: float) -> float:
    """The same for one position and the key of a shape. Raises ValueError where there is no answer."""
    shape = shape_of(key)
    at, columns = positions_at(shape), [np.array([number], np.float64) for number in numbers]
    if not at.allows(*columns)[0]:
        raise ValueError(f"({', '.join(f'{number:g}' for number in numbers)}) is out of range for place {shape.name}")
    return float(AT[name](at, *columns)[0])


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
