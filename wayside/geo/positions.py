"""Positions relative to areas, lines and lanes. One position gives the same numbers as many at once.

All computations use only addition, multiplication, division and square roots, which give the same bits on every
processor.
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
    """Positions relative to a line; float64[n] each, in metres except for `direction`."""

    along: Doubles
    """The distance along the line from its start: negative before the start, greater than the length beyond the end."""
    across: Doubles
    """The distance to the left of the line; negative to the right."""
    distance: Doubles
    """The distance to the nearest point of the line."""
    direction: Doubles
    """The direction of the line there, in degrees counter-clockwise from the first axis, or from east."""


class Positions:
    """Computes positions relative to one shape. Columns are float64[n]."""

    def __init__(self, shape: Shape) -> None:
        """It keeps the data of the shape, and no reference to the shape itself."""
        self._geographic, self._width = shape.geographic, shape.width
        self._rings, self._line = shape.rings, shape.line

    def allows(self, u: Doubles, v: Doubles, *headings: Doubles) -> Bools:
        """bool[n]: whether (u, v) is a valid position, and the headings are finite."""
        u_limit, v_limit = (90.0, 360.0) if self._geographic else (FARTHEST, FARTHEST)
        found: Bools = (np.abs(u) <= u_limit) & (np.abs(v) <= v_limit)
        for each in headings:
            found = found & np.isfinite(each)
        return found

    def inside(self, u: Doubles, v: Doubles) -> Bools:
        """bool[n]: whether positions are inside, or on the edge: exact for an area; a lane has only its width."""
        if self._rings:
            return self._in_rings(u, self._unrolled(v))
        found: Bools = self._beside(self.arc(u, v)) == 0
        return found

    def distance(self, u: Doubles, v: Doubles) -> Doubles:
        """The distance to the area or lane in metres, 0 inside; without area and width, the distance to the line."""
        if self._rings:
            x, y = self._metres(u, v)
            nearest = np.sqrt(np.minimum.reduce([_nearest(x, y, each).squares for each in self._outlines]))
            return np.where(self.inside(u, v), 0.0, nearest)
        arc = self.arc(u, v)
        return arc.distance if self._width is None else self._beside(arc)

    def arc(self, u: Doubles, v: Doubles) -> Arc:
        """The positions relative to the line."""
        return _arc(*self._metres(u, v), self._segments)

    def _beside(self, arc: Arc) -> Doubles:
        """The distance to the lane of this width in metres, 0 inside."""
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
        """Metres per degree of latitude and of longitude at the origin, on the ellipsoid."""
        return geodesy.degrees(self._origin[0])

    def _unrolled(self, v: Doubles) -> Doubles:
        """Longitudes within half a turn of the origin's, so that the antimeridian is no seam."""
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
    """The computation for a shape, prepared once."""
    found = _KNOWN.get(shape)
    if found is None:
        found = _KNOWN[shape] = Positions(shape)
    return found


def turn(start: Doubles, end: Doubles) -> Doubles:
    """The turn from one direction to another, in degrees in (-180, 180], positive to the left."""
    by = np.remainder(end - start, 360.0)
    return np.where(by > 180.0, by - 360.0, by)


AT: Final[Mapping[str, Callable[..., Doubles]]] = {
    "at_inside": lambda at, u, v: at.inside(u, v).astype(np.float64),
    "at_distance": Positions.distance,
    "at_along": lambda at, u, v: at.arc(u, v).along,
    "at_across": lambda at, u, v: at.arc(u, v).across,
    "at_heading": lambda at, u, v, heading: turn(at.arc(u, v).direction, heading),
}
"""The functions behind the fields of `at(position, place)`, by name. Their arguments are a `Positions` and columns."""


def at_one(name: str, key: str, *numbers: float) -> float:
    """The function's result for one position and the key of a shape. Raises ValueError for a position out of range."""
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
    """The distance along the line at which each segment begins."""
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
    """The position along the segment: 0 at its start, 1 at its end."""
    squares: Doubles
    """The squares of the distances."""


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
    # At a corner, the bisector decides about the side: behind a sharp corner, either segment alone would be wrong.
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
