"""The functions of numbers over columns, with exactly the doubles that they return to CEL.

A few functions have an exact form in numpy: tests compare every bit. The sine, cosine, arctangent and hypotenuse of
numpy sometimes differ from those of Python, and between processors. So these functions run row by row, at a tenth of
CEL's cost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from wayside.expressions.columns.values import Bools, Doubles
from wayside.expressions.functions import FUNCTIONS, OF_FIELDS
from wayside.expressions.functions.declaring import ArgumentType, ResultType
from wayside.geo.geometry import Shape
from wayside.geo.positions import AT, positions_at

Called = tuple[str, int] | tuple[str, int, Shape]
"""A function, the number of its arguments, and the place that it refers to, if any."""
Answer = tuple[Doubles, Bools | None]
"""The results, and whether there is one; None: everywhere."""
Vectorised = Callable[..., Answer]


def _smaller(x: Doubles, y: Doubles) -> Answer:
    return np.where(y < x, y, x), None


def _larger(x: Doubles, y: Doubles) -> Answer:
    return np.where(y > x, y, x), None


def _within(angle: Doubles, whole: float) -> Doubles:
    """As Python's `%`. Angles in [0, whole) are unchanged, and skip the slow division."""
    beyond = ~((angle >= 0) & (angle < whole))
    found: Doubles = angle + 0.0  # -0.0 % 360.0 is 0.0
    return np.remainder(angle, whole, out=found, where=beyond) if beyond.any() else found


def _turn(whole: float) -> Vectorised:
    def turn(start: Doubles, end: Doubles) -> Answer:
        by = _within(end, whole) - _within(start, whole)
        wrapped = np.where(by > whole / 2, by - whole, np.where(by <= -whole / 2, by + whole, by))
        return wrapped, np.isfinite(start) & np.isfinite(end)

    return turn


VECTORISED: Final[dict[tuple[str, int], Vectorised]] = {
    ("abs", 1): lambda x: (np.abs(x), None),
    ("sqrt", 1): lambda x: (np.sqrt(x), x >= 0),
    ("smaller", 2): _smaller,
    ("larger", 2): _larger,
    ("degrees", 1): lambda radians: (radians * (180.0 / math.pi), None),
    ("radians", 1): lambda degrees: (degrees * (math.pi / 180.0), None),
    ("headingDifference", 2): _turn(360.0),
    ("angleDifference", 2): _turn(math.tau),
    ("timeToCollision", 2): lambda gap, closing: (
        np.where(gap <= 0, 0.0, np.where(closing > 0, gap / closing, np.inf)),
        None,
    ),
}
"""The functions by name and number of arguments. Where a result is used, no argument is NaN."""


def _scalar_functions() -> dict[tuple[str, int], Callable[..., float]]:
    found: dict[tuple[str, int], Callable[..., float]] = {}
    for function in (*FUNCTIONS.values(), *OF_FIELDS.values()):
        for signature in function.signatures:
            alone = sum(len(each.parameters) == len(signature.parameters) for each in function.signatures) == 1
            numbers = all(parameter.type is ArgumentType.NUMBER for parameter in signature.parameters)
            if function.result is ResultType.NUMBER and alone and numbers:
                found[function.name, len(signature.parameters)] = signature.implementation  # type: ignore[assignment]
    return found


SCALAR: Final = _scalar_functions()
"""The functions that take only numbers and yield a number, by name and number of arguments."""


def takes_columns(name: str, count: int) -> bool:
    """Whether the function with this number of arguments can be evaluated over columns."""
    return (name, count) in SCALAR


def about_place(name: str) -> bool:
    """Whether the last argument of the function is the key of a place."""
    return name in AT


def calculate(called: Called, given: Sequence[Doubles], wanted: Bools) -> Answer:
    """The function's results where `wanted` is true, and whether there is one.

    The given arrays are broadcast to the shape of `wanted`.
    """
    key = called[0], len(given)
    if len(called) == 3:
        return _placed(called[0], called[2], given, wanted)
    if key in VECTORISED:
        return VECTORISED[key](*given)
    results = np.zeros(wanted.shape)
    everywhere = bool(wanted.all())
    whole = [np.broadcast_to(each, wanted.shape) for each in given]
    arguments = [(each if everywhere else each[wanted]).ravel().tolist() for each in whole]
    answers, answered = _row_by_row(SCALAR[key], arguments)
    if everywhere:
        return answers.reshape(wanted.shape), None if answered is None else answered.reshape(wanted.shape)
    results[wanted] = answers
    if answered is None:
        return results, None
    known = np.zeros(wanted.shape, bool)
    known[wanted] = answered
    return results, known


def _placed(name: str, shape: Shape, given: Sequence[Doubles], wanted: Bools) -> Answer:
    """A function of positions relative to a place."""
    whole = [np.broadcast_to(each, wanted.shape) for each in given]
    at = positions_at(shape)
    known = wanted & at.allows(*whole)
    results = np.zeros(wanted.shape)
    results[known] = AT[name](at, *(each[known] for each in whole))
    return results, known


def _row_by_row(function: Callable[..., float], arguments: Sequence[Sequence[float]]) -> tuple[Doubles, Bools | None]:
    count = len(arguments[0])
    try:
        return np.fromiter(map(function, *arguments), np.float64, count), None
    except (ValueError, ArithmeticError):
        pass
    answers, answered = np.zeros(count), np.zeros(count, bool)
    for row, given in enumerate(zip(*arguments, strict=True)):
        try:
            answers[row] = function(*given)
        except (ValueError, ArithmeticError):  # no result for these arguments: unknown
            continue
        answered[row] = True
    return answers, answered
