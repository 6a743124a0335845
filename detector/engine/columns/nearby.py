"""Which pairs of clients are within reach of each other, in columns: see `detector.engine.scoping.nearness`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from detector.engine.columns.table import Integers, Truths
from detector.engine.scoping.nearness import FEW, ROOM, Search, near_pairs, reach
from detector.engine.scoping.positions import Point
from wayside.expressions.columns.values import Doubles
from wayside.rules import PairSubject

_MANY = 1 << 17
"""Up to this number of possible pairs, they are created without being counted first."""

_HASHES = np.array([1, 0x9E3779B1, 0x85EBCA77])
"""Spread the cells of a grid over buckets, by axis."""


class Nearby(NamedTuple):
    """Pairs, in order of the names of their first and second clients."""

    first: Integers
    second: Integers
    """The clients' indices."""
    distance: Doubles
    left_out: int
    """The number of pairs within reach that exceeded the maximum."""


class ClientPositions(NamedTuple):
    """Clients, in order of their names."""

    names: Sequence[str]
    points: Callable[[Integers], Doubles]
    """The points of clients whose place is known: see `Search`."""
    distances: Callable[[Integers, Integers], Doubles]
    first: Truths
    """Which clients can be the first of a pair; their place is known."""
    second: Truths


def nearby(clients: ClientPositions, subject: PairSubject) -> Nearby:
    """The pairs within reach; if they exceed the subject's maximum, the nearest ones, then by names."""
    first, second = np.flatnonzero(clients.first), np.flatnonzero(clients.second)
    if len(first) * len(second) <= FEW:
        i, j = np.repeat(first, len(second)), np.tile(second, len(first))
    else:
        # Not at the top: the import takes half a second, which a detector with few clients can save.
        from scipy.spatial import cKDTree  # noqa: PLC0415

        radius, same = reach(subject.within), np.array_equal(first, second)
        # Trees that are not balanced are built in half the time, and searched as fast where points are spread.
        one = cKDTree(clients.points(first), balanced_tree=False, compact_nodes=False)
        other = one if same else cKDTree(clients.points(second), balanced_tree=False, compact_nodes=False)
        points = clients.points(np.flatnonzero(clients.first | clients.second))
        if _most(points, radius) > max(subject.maximum * ROOM, _MANY):
            themselves = int((clients.first & clients.second).sum())
            found = (int(one.count_neighbors(other, radius)) - themselves) // (1 if subject.ordered else 2)
            if found > subject.maximum * ROOM:
                return _crowded(clients, subject, first, second)
        if not subject.ordered:
            pairs = one.query_pairs(radius, output_type="ndarray")
            i, j = first[pairs[:, 0]], first[pairs[:, 1]]
        elif same:
            pairs = one.query_pairs(radius, output_type="ndarray")
            i, j = first[np.concatenate((pairs[:, 0], pairs[:, 1]))], first[np.concatenate((pairs[:, 1], pairs[:, 0]))]
        else:
            matrix = one.sparse_distance_matrix(other, radius, output_type="ndarray")
            i, j = first[matrix["i"]], second[matrix["j"]]
    distance = clients.distances(i, j)
    near = (distance <= subject.within) & (i != j if subject.ordered else i < j)
    i, j, distance = i[near], j[near], distance[near]
    found = len(i)
    if len(i) > subject.maximum:
        nearest = np.lexsort((j, i, distance))[: subject.maximum]
        i, j, distance = i[nearest], j[nearest], distance[nearest]
    return _in_order(i, j, distance, found - len(i))


def _most(points: Doubles, radius: float) -> int:
    """An upper bound of the ordered pairs of points within the radius; costs a tenth of counting them.

    Such a pair lies in one cell of a grid or in two neighbouring ones, and over all cells c the sum of the products of
    neighbours' counts n(c)·n(c + d) is at most that of n(c)² (Cauchy and Schwarz). Cells that share a bucket only
    increase the bound.
    """
    axes = points.shape[1]
    buckets = 1 << (len(points).bit_length() + 3)
    cells = np.floor(points / radius).astype(np.int64) @ _HASHES[:axes] & (buckets - 1)
    counts = np.bincount(cells)
    return int(3**axes * (counts @ counts))


def _crowded(clients: ClientPositions, subject: PairSubject, first: Integers, second: Integers) -> Nearby:
    """The nearest pairs if far more are within reach than the maximum: does not create all of them."""
    names = clients.names
    index = {names[at]: at for at in np.union1d(first, second).tolist()}

    def between(a: str, b: str) -> float:
        return float(clients.distances(np.array([index[a]]), np.array([index[b]]))[0])

    everybody = np.array([*index.values()], np.int64)
    points = {name: _point(*each) for name, each in zip(index, clients.points(everybody).tolist(), strict=True)}
    roles = ([names[at] for at in first.tolist()], [names[at] for at in second.tolist()])
    found = near_pairs(
        Search(points, between, *(roles if subject.ordered else (None, None))), subject.within, subject.maximum
    )
    i = np.array([index[a] for a, _ in found.pairs], np.int64)
    j = np.array([index[b] for _, b in found.pairs], np.int64)
    return _in_order(i, j, clients.distances(i, j), found.left_out)


def _point(x: float, y: float, z: float = 0.0) -> Point:
    return (x, y, z)


def _in_order(i: Integers, j: Integers, distance: Doubles, left_out: int) -> Nearby:
    order = np.argsort((i << 32) + j)  # in half the time of np.lexsort
    return Nearby(i[order], j[order], distance[order], left_out)
