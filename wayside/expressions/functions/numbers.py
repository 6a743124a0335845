"""Mathematical functions on numbers and lists of numbers that CEL does not have."""

from __future__ import annotations

import math
from collections.abc import Callable

from wayside.expressions.functions.declaring import ResultType, function
from wayside.expressions.functions.members import number, sequence


def of_list(calculate: Callable[[list[float]], float]) -> Callable[[object], float]:
    """A calculation over the numbers of a list, without null and NaN; ValueError if no number remains."""

    def calculated(values: object) -> float:
        items = sequence(values, "values")
        known = [
            number(item, f"values[{index}]")
            for index, item in enumerate(items)
            if item is not None and item == item  # noqa: PLR0124 (NaN alone differs from itself)
        ]
        if not known:
            raise ValueError("no value for values: no item of the list is known")
        return calculate(known)

    return calculated


def square_root(x: float) -> float:
    """The square root of a number that is not negative."""
    if x < 0:
        raise ValueError(f"sqrt needs a number of 0 or more; got {x:g}")
    return math.sqrt(x)


def _sum(values: list[float]) -> float:
    try:
        return math.fsum(values)
    except (OverflowError, ValueError):  # beyond a double, or infinite both ways
        return sum(values)


def _mean(values: list[float]) -> float:
    return _sum(values) / len(values)


FUNCTIONS = (
    function("abs", ResultType.NUMBER, "the absolute value", (abs, "x")),
    function("sqrt", ResultType.NUMBER, "the square root; x ≥ 0", (square_root, "x")),
    function("hypot", ResultType.NUMBER, "√(x² + y²), √(x² + y² + z²)", (math.hypot, "x y"), (math.hypot, "x y z")),
    function("sin", ResultType.NUMBER, "the sine", (math.sin, "radians")),
    function("cos", ResultType.NUMBER, "the cosine", (math.cos, "radians")),
    function("atan2", ResultType.NUMBER, "the angle of (x, y), radians in [-π, π]", (math.atan2, "y x")),
    function("smaller", ResultType.NUMBER, "the smaller of two numbers", (min, "x y")),
    function("larger", ResultType.NUMBER, "the larger of two numbers", (max, "x y")),
    function("minimum", ResultType.NUMBER, "the smallest number of a list", (of_list(min), "values:list")),
    function("maximum", ResultType.NUMBER, "the largest number of a list", (of_list(max), "values:list")),
    function("mean", ResultType.NUMBER, "the mean of a list", (of_list(_mean), "values:list")),
    function("sum", ResultType.NUMBER, "the sum of a list", (of_list(_sum), "values:list")),
)
