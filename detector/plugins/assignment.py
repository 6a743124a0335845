"""Matches two sets of points: as many pairs within a gate as possible, the nearest of these."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
