"""The results of conditions: verdicts, and the observations derived from them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.table import Truths
from detector.engine.episodes.episodes import FALSE, OUTSIDE, TRUE, UNSURE, UNTIL, UNTIL_UNSURE

Codes = NDArray[np.uint8]
"""Observations, see `SubjectState.run`."""


class Ternary(NamedTuple):
    """Where a condition is true and where it is false; it is unknown at all other points."""

    true: Truths
    false: Truths


def observed(when: Ternary, until: Ternary, scope: Ternary | None = None, start: Ternary | None = None) -> Codes:
    """The observations of arrays of points of any shape.

    `scope`: whether a point is in the rule's scope; outside, open episodes end. `start`: whether an episode may start
    at all. None: true everywhere.
    """
    may, not_ = when.true & until.false, when.false | until.true
    for each in (scope, start):
        if each is not None:
            may = may & each.true
            not_ = not_ | each.false
    codes = np.where(not_, np.uint8(FALSE), np.where(may, np.uint8(TRUE), np.uint8(UNSURE)))
    codes |= np.where(until.true, np.uint8(UNTIL), np.where(until.false, np.uint8(0), np.uint8(UNTIL_UNSURE)))
    if scope is not None:
        codes[scope.false] = FALSE | OUTSIDE
    return codes
