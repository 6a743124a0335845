"""Areas, lines and lanes, and exact tests for single points. `positions` computes over many points."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import Final
from weakref import WeakValueDictionary

Point = tuple[float, float]

FARTHEST: Final = 1e12
"""The largest valid coordinate, in metres."""
DOUBT: Final = 4e-16
"""If a difference of products is smaller than this fraction of its terms, its sign is uncertain."""


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
        """The name with a digest of the content: equal shapes have equal keys."""
        content = json.dumps([self.name, self.geographic, self.rings, self.line, self.width])
        return f"{self.name}#{hashlib.sha256(content.encode()).hexdigest()[:16]}"

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields of `at(position, place)` that exist for this shape."""
        bounded = ("inside",) if self.rings or self.width is not None else ()
        return (*bounded, "distance", *(("along", "across", "heading") if self.line else ()))


_SHAPES: WeakValueDictionary[str, Shape] = WeakValueDictionary()


def interned(shape: Shape) -> Shape:
    """The one shape of this key. `shape_of` finds it as long as it is referenced."""
    return _SHAPES.setdefault(shape.key, shape)


def shape_of(key: str) -> Shape:
    """The shape of a key. Raises ValueError if the shape is no longer referenced."""
    try:
        return _SHAPES[key]
    except KeyError:
        raise ValueError(f"the place {key.partition('#')[0]} no longer exists") from None


def contains(rings: Iterable[Sequence[Point]], point: Point) -> bool:
    """Whether the point is inside the outlines by the even-odd rule, or on an edge.

    The point is inside if a ray along the first axis crosses the edges an odd number of times. The test is exact, so
    that points on an edge are inside.
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
    """Positive if the point is left of the line from a to b, 0 on the line, negative if it is right of it.

    If the sign is uncertain, it is computed with exact fractions.
    """
    (ax, ay), (bx, by), (x, y) = a, b, point
    left, right = (bx - ax) * (y - ay), (by - ay) * (x - ax)
    value = left - right
    if abs(value) > DOUBT * (abs(left) + abs(right)) and math.isfinite(value):
        return value
    exact = (Fraction(bx) - Fraction(ax)) * (Fraction(y) - Fraction(ay)) - (Fraction(by) - Fraction(ay)) * (
        Fraction(x) - Fraction(ax)
    )
    return (exact > 0) - (exact < 0)


def crossing(ring: Sequence[Point]) -> tuple[int, int] | None:
    """Two edges of an outline that cross or touch, by their first corners; None if there are none."""
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
    """Whether the second of two edges on one line goes back over the first."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = a, b, c, d
    return (bx - ax) * (dx - cx) + (by - ay) * (dy - cy) < 0
