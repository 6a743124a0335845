"""Compares lists of objects, such as the detections of two sensors in one scene, without CEL's limit on iterations.

Objects are matched only by their positions. `path` is the path of an object's coordinates, such as
`bbox.center.position`; `members.place` describes the default paths.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right

from wayside.expressions.functions.declaring import ResultType, function
from wayside.expressions.functions.members import Place, place, sequence


def unmatched(items: object, others: object, within: float, path: str = "") -> list[float]:
    """The indices of the items of one list that have no item of the other list within this distance in metres."""
    if within < 0:
        raise ValueError(f"within must be 0 or more metres; got {within:g}")
    places = _places(items, "items", path)
    by_x = sorted(_places(others, "others", path))
    xs = [each[0] for each in by_x]
    return [float(index) for index, here in enumerate(places) if not _has_neighbour(here, by_x, xs, within)]


def count_unmatched(items: object, others: object, within: float, path: str = "") -> float:
    """The number of items that `unmatched` returns."""
    return float(len(unmatched(items, others, within, path)))


def nearest(items: object, x: float, y: float, path: str = "") -> float:
    """The distance in the plane from (x, y) to the nearest item, in metres; infinite if the list is empty."""
    return min((math.hypot(px - x, py - y) for px, py, _ in _places(items, "items", path)), default=math.inf)


def _places(items: object, what: str, path: str) -> list[Place]:
    return [place(item, f"{what}[{index}]", path) for index, item in enumerate(sequence(items, what))]


def _has_neighbour(here: Place, by_x: list[Place], xs: list[float], within: float) -> bool:
    # Slightly wider than `within`: the rounded distance decides.
    reach = within * (1 + 1e-9)
    first, last = bisect_left(xs, here[0] - reach), bisect_right(xs, here[0] + reach)
    return any(math.dist(here, there) <= within for there in by_x[first:last])


FUNCTIONS = (
    function(
        "unmatched",
        ResultType.LIST,
        "the indices of those items that have none of the others within this distance, metres",
        (unmatched, "items:list others:list within"),
        (unmatched, "items:list others:list within path:string"),
    ),
    function(
        "countUnmatched",
        ResultType.NUMBER,
        "the number of those items that have none of the others within this distance, metres",
        (count_unmatched, "items:list others:list within"),
        (count_unmatched, "items:list others:list within path:string"),
    ),
    function(
        "nearest",
        ResultType.NUMBER,
        "metres from (x, y) to the nearest item of a list; infinite if the list is empty",
        (nearest, "items:list x y"),
        (nearest, "items:list x y path:string"),
    ),
)
