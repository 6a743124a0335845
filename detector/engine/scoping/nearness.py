"""Which pairs of clients are within reach of each other: the nearest ones, up to a maximum number.

For a few clients, all pairs are compared. For more, a tree counts the pairs before any is created: a thousand clients
at one spot form half a million pairs, and creating them only to drop most would stall everything else.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from detector.engine.scoping.positions import Point

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Pair = tuple[str, str]

Distance = Callable[[str, str], float]
"""The distance between two clients in metres, as in expressions."""

FEW = 1024
"""Maximum number of pairs for which comparing all is faster than building trees."""

_ROUNDING = 1 + 1e-9
_TOLERANCE = 1e-6
"""The trees search slightly beyond the limit, by this factor and this number of metres, so that rounding hides no pair;
`distance` decides. Points on the Earth are 6,400 km from the origin, so they are exact to a nanometre only."""

ROOM = 4
"""Up to this multiple of the requested number of pairs is created, to be sorted exactly."""

_MAXIMUM_BISECTIONS = 40


class Near(NamedTuple):
    """The result of a search."""

    pairs: list[Pair]
    left_out: int
    """The number of pairs within reach that exceeded the maximum. With many clients it may include pairs that are
    out of reach by a micrometre or a billionth."""


class Search(NamedTuple):
    """The clients to search among."""

    points: Mapping[str, Point]
    """The clients' places; straight distances are never longer than `distance`."""
    distance: Distance
    first: Collection[str] | None
    """The possible first clients of a pair; None: the first is the one with the smaller name."""
    second: Collection[str] | None
    """The possible second clients, if `first` is given."""


def reach(within: float) -> float:
    """How far trees search for pairs that are at most `within` metres apart."""
    return within * _ROUNDING + _TOLERANCE


def near_pairs(search: Search, within: float, maximum: int) -> Near:
    """The pairs that are at most `within` metres apart; if more than `maximum`, the nearest, then by names."""
    first = sorted(search.points if search.first is None else search.points.keys() & search.first)
    second = sorted(search.points if search.second is None else search.points.keys() & search.second)
    if len(first) * len(second) <= FEW:
        return _nearest(search, ((a, b) for a in first for b in second), within, maximum)
    return _by_trees(search, first, second, within, maximum)


def _fits(search: Search, a: str, b: str) -> bool:
    return a < b if search.first is None else a != b


def _nearest(search: Search, pairs: Iterator[Pair], within: float, maximum: int) -> Near:
    """The given pairs that are within reach by their exact distance; at most `maximum`, the nearest."""
    measured = [(search.distance(a, b), a, b) for a, b in pairs if _fits(search, a, b)]
    reached = [each for each in measured if each[0] <= within]
    if len(reached) <= maximum:
        return Near([(a, b) for _, a, b in reached], 0)
    reached.sort()
    return Near([(a, b) for _, a, b in reached[:maximum]], len(reached) - maximum)


def _by_trees(search: Search, first: list[str], second: list[str], within: float, maximum: int) -> Near:
    # Not at the top: the import takes half a second, which a detector with few clients can save.
    from scipy.spatial import cKDTree  # noqa: PLC0415

    one = cKDTree(np.array([search.points[name] for name in first]))
    other = one if first == second else cKDTree(np.array([search.points[name] for name in second]))
    radius = reach(within)
    # Each client is near itself; without roles, each pair is found from both sides.
    themselves = len(set(first) & set(second))
    sides = 2 if search.first is None else 1

    def count(distance: float) -> int:
        return (int(one.count_neighbors(other, distance)) - themselves) // sides

    found = count(radius)
    if found <= maximum * ROOM:
        return _nearest(search, _all(one, other, first, second, radius), within, maximum)
    low, high = 0.0, radius
    for _ in range(_MAXIMUM_BISECTIONS):
        middle = (low + high) / 2
        number = count(middle)
        if number < maximum:
            low = middle
        else:
            high = middle
            if number <= maximum * ROOM:
                break
    if count(high) <= maximum * ROOM:
        pairs = _nearest(search, _all(one, other, first, second, high), within, maximum).pairs
    else:
        # Too many pairs have the same distance: take the nearer pairs, then the others by name, up to the maximum.
        nearer = _nearest(search, _all(one, other, first, second, low), within, maximum).pairs if low else []
        pairs = _filled(search, nearer, _between(one, other, first, second, high), within, maximum)
    return Near(pairs, found - len(pairs))


def _all(one: cKDTree, other: cKDTree, first: list[str], second: list[str], radius: float) -> Iterator[Pair]:
    """The pairs between the two trees, from one query."""
    if one is other:
        for i, j in one.query_pairs(radius, output_type="ndarray").tolist():
            yield first[i], first[j]
            yield first[j], first[i]
        return
    for name, found in zip(first, one.query_ball_tree(other, radius), strict=True):
        for near in found:
            yield name, second[near]


def _between(one: cKDTree, other: cKDTree, first: list[str], second: list[str], radius: float) -> Iterator[Pair]:
    """The pairs between the two trees, by names, from one query per client."""
    for index, name in enumerate(first):
        for near in sorted(other.query_ball_point(one.data[index], radius)):
            yield name, second[near]


def _filled(search: Search, nearer: list[Pair], more: Iterator[Pair], within: float, maximum: int) -> list[Pair]:
    pairs = dict.fromkeys(nearer)
    for a, b in more:
        if len(pairs) >= maximum:
            break
        if _fits(search, a, b) and search.distance(a, b) <= within:
            pairs[a, b] = None
    return list(pairs)
