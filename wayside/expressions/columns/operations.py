"""Runs one step: the same operation for k nodes over n rows, written into the frame's arrays in place.

If all leaves are numbers, nodes that cannot be unknown then do not fill `known` and `false`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from wayside.expressions.columns.frame import ABSENT, BOOLEAN, NUMBER, ONE, THREE, Array, Frame, Operand
from wayside.expressions.columns.functions import Called, calculate
from wayside.expressions.columns.nodes import Op
from wayside.expressions.columns.values import Bools, Bytes, Doubles, Tag

TEXT: Final = np.uint8(Tag.TEXT)


@dataclass(frozen=True, slots=True)
class Step:
    """One operation for k nodes: their operands, and the place of the results."""

    op: Op
    operands: tuple[Operand, ...]
    out: slice
    partial: bool
    into: Array
    function: Called = ("", 0)

    def __call__(self, frame: Frame) -> None:
        """Runs the step."""
        _OPERATIONS[self.op](frame, self)


Run = Callable[[Frame, Step], None]


def _put_known(frame: Frame, step: Step, *knowns: Bools | None) -> None:
    """The results are known if all operands are known."""
    if not (frame.tagged or step.partial):
        return
    out = frame.known[step.out]
    conditions = [each for each in knowns if each is not None]
    if not conditions:
        out[...] = True
    elif len(conditions) == 1:
        out[...] = conditions[0]
    else:
        np.logical_and(conditions[0], conditions[1], out=out)
        for each in conditions[2:]:
            np.logical_and(out, each, out=out)


def _put_false(frame: Frame, step: Step, known: Bools | None) -> None:
    """Completes a comparison whose `true` is written: it is true only if known, and false if known and not true."""
    true = frame.true[step.out]
    if known is not None:
        np.logical_and(true, known, out=true)
        np.greater(known, true, out=frame.false[step.out])
    elif frame.tagged or step.partial:
        np.logical_not(true, out=frame.false[step.out])


def _arithmetic(calculation: np.ufunc, frame: Frame, step: Step) -> None:
    (x, x_known), (y, y_known) = frame.number(step.operands[0]), frame.number(step.operands[1])
    calculation(x, y, out=frame.numbers[step.out])
    _put_known(frame, step, x_known, y_known)


def _one_number(calculation: np.ufunc, frame: Frame, step: Step) -> None:
    x, known = frame.number(step.operands[0])
    calculation(x, out=frame.numbers[step.out])
    _put_known(frame, step, known)


def _call(frame: Frame, step: Step) -> None:
    out = frame.numbers[step.out]
    given: list[Doubles] = []
    wanted = np.ones(out.shape, bool)
    for operand in step.operands:
        x, known = frame.number(operand)
        given.append(x)
        if known is not None:
            wanted &= known
        if operand.source is not Array.CONSTANT:
            wanted &= ~np.isnan(x)  # no function takes NaN
    results, answered = calculate(step.function, given, wanted)
    out[...] = results
    _put_known(frame, step, wanted, answered)


def _order(comparison: np.ufunc, frame: Frame, step: Step) -> None:
    true = frame.true[step.out]
    first, second = step.operands
    if _numeric(first) or _numeric(second):
        (x, x_known), (y, y_known) = frame.number(first), frame.number(second)
        comparison(x, y, out=true)
        _put_false(frame, step, y_known if x_known is None else x_known if y_known is None else x_known & y_known)
        return
    (x, x_tags), (y, y_tags) = frame.anything(first), frame.anything(second)
    comparison(x, y, out=true)
    if x_tags is None and y_tags is None:
        _put_false(frame, step, None)
        return
    tags, others = (y_tags, NUMBER) if x_tags is None else (x_tags, NUMBER if y_tags is None else y_tags)
    assert tags is not None  # noqa: S101
    # Numbers are ordered, and so are booleans.
    _put_false(frame, step, (tags == others) & ((tags == NUMBER) | (tags == BOOLEAN)))


def _numeric(operand: Operand) -> bool:
    return operand.source is Array.NUMBERS or (operand.source is Array.CONSTANT and operand.tags is None)


def _equal(frame: Frame, step: Step) -> None:
    true = frame.true[step.out]
    (x, x_tags), (y, y_tags) = (frame.anything(each) for each in step.operands)
    np.equal(x, y, out=true)
    if x_tags is None and y_tags is None:
        _put_false(frame, step, None)
        return
    np.logical_and(true, (NUMBER if x_tags is None else x_tags) == (NUMBER if y_tags is None else y_tags), out=true)
    knowns = [_comparable(each) for each in (x_tags, y_tags) if each is not None]
    known = knowns[0] if len(knowns) == 1 else knowns[0] & knowns[1]
    if frame.tagged or step.partial:
        _put_false(frame, step, known)


def _comparable(tags: Bytes) -> Bools:
    """The rows with a number, a boolean or a string."""
    found: Bools = tags - ONE < THREE  # 0 − 1 is 255
    return found


def _junction(of_true: np.ufunc, of_false: np.ufunc, frame: Frame, step: Step) -> None:
    first, second = step.operands
    if not (frame.tagged or step.partial):
        of_true(_true(frame, first), _true(frame, second), out=frame.true[step.out])
        return
    (x_true, x_false), (y_true, y_false) = frame.truth(first), frame.truth(second)
    of_true(x_true, y_true, out=frame.true[step.out])
    of_false(x_false, y_false, out=frame.false[step.out])


def _true(frame: Frame, operand: Operand) -> Bools:
    return frame.true[operand.rows] if operand.source is Array.TRUTHS else frame.truth(operand)[0]


def _not(frame: Frame, step: Step) -> None:
    if not (frame.tagged or step.partial):
        np.logical_not(_true(frame, step.operands[0]), out=frame.true[step.out])
        return
    frame.false[step.out], frame.true[step.out] = frame.truth(step.operands[0])


def _truth(frame: Frame, step: Step) -> None:
    frame.true[step.out], frame.false[step.out] = frame.truth(step.operands[0])


def _never(frame: Frame, step: Step) -> None:
    frame.true[step.out] = False
    frame.false[step.out] = False


def _has(frame: Frame, step: Step) -> None:
    true = frame.true[step.out]
    if not frame.tagged:
        true[...] = True
        return
    tags = frame.leaf_tags[step.operands[0].rows]
    absent = tags == ABSENT
    frame.false[step.out] = absent
    np.logical_not(absent | (tags == Tag.UNREACHABLE), out=true)


def _choose(frame: Frame, step: Step) -> None:
    condition, first, second = step.operands
    yes, no = frame.truth(condition)
    match step.into:
        case Array.NUMBERS:
            (x, x_known), (y, y_known) = frame.number(first), frame.number(second)
            frame.numbers[step.out] = np.where(yes, x, y)
            if frame.tagged or step.partial:
                frame.known[step.out] = (yes if x_known is None else yes & x_known) | (
                    no if y_known is None else no & y_known
                )
        case Array.TRUTHS:
            (x_true, x_false), (y_true, y_false) = frame.truth(first), frame.truth(second)
            frame.true[step.out] = (yes & x_true) | (no & y_true)
            frame.false[step.out] = (yes & x_false) | (no & y_false)
        case _:
            (x, x_tags), (y, y_tags) = frame.anything(first), frame.anything(second)
            frame.mixed[step.out] = np.where(yes, x, y)
            of_second = np.where(no, NUMBER if y_tags is None else y_tags, ABSENT)
            frame.mixed_tags[step.out] = np.where(yes, NUMBER if x_tags is None else x_tags, of_second)


def _text(frame: Frame, step: Step) -> None:
    values, tags = frame.anything(step.operands[0])
    frame.mixed[step.out] = values
    frame.mixed_tags[step.out] = ABSENT if tags is None else np.where(tags == TEXT, TEXT, ABSENT)


_OPERATIONS: Final[Mapping[Op, Run]] = {
    Op.ADD: partial(_arithmetic, np.add),
    Op.SUBTRACT: partial(_arithmetic, np.subtract),
    Op.MULTIPLY: partial(_arithmetic, np.multiply),
    Op.DIVIDE: partial(_arithmetic, np.divide),
    Op.NEGATE: partial(_one_number, np.negative),
    Op.CALL: _call,
    Op.LESS: partial(_order, np.less),
    Op.LESS_EQUAL: partial(_order, np.less_equal),
    Op.EQUAL: _equal,
    Op.AND: partial(_junction, np.logical_and, np.logical_or),
    Op.OR: partial(_junction, np.logical_or, np.logical_and),
    Op.NOT: _not,
    Op.HAS: _has,
    Op.CHOOSE: _choose,
    Op.NUMBER: partial(_one_number, np.positive),
    Op.TRUTH: _truth,
    Op.TEXT: _text,
    Op.NEVER: _never,
}

UNKNOWN_OF_NUMBERS: Final = frozenset({Op.CALL, Op.NUMBER, Op.TRUTH, Op.TEXT, Op.NEVER})
"""The operations that can be unknown even if all leaves are numbers. The others are unknown only if an operand is."""
