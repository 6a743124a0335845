"""Loops over a list whose items are rows: each loop becomes a fold of a predicate; the rest reads the folds' results.

    members.exists(m, m.v > 1) && size(members) > 2
        →  fold0 && fold1 > 2        fold0: ANY of `m.v > 1`        fold1: COUNT of all

A fold follows Kleene's logic, as CEL's macros do: `exists` is unknown if no item is true and one is unknown, and
`filter` is unknown if any item is unknown.
"""

from __future__ import annotations

import enum
from typing import Final, NamedTuple

from wayside.expressions.cel import CelType, Expression
from wayside.expressions.columns.lowering import Part
from wayside.expressions.syntax import Call, Collection, Loop, Name, Node, Scalar, Select


class FoldKind(enum.Enum):
    """The kind of a fold over the booleans of its rows."""

    ANY = enum.auto()
    ALL = enum.auto()
    COUNT = enum.auto()
    """The number of true rows."""


class Fold(NamedTuple):
    """A fold of a predicate over the items."""

    kind: FoldKind
    variable: str
    """The variable of an item in the predicate."""
    predicate: Part | None
    """None: the predicate is true for every item."""


class Folded(NamedTuple):
    """An expression without its loops."""

    rest: Part
    """The expression that reads the results of the folds as variables of these names."""
    folds: dict[str, Fold]


_KINDS: Final = {FoldKind.ANY: CelType.BOOL, FoldKind.ALL: CelType.BOOL, FoldKind.COUNT: CelType.DOUBLE}


def folded(expression: Expression, items: str) -> Folded:
    """The expression with each loop over the list `items` replaced by a fold; other loops stay."""
    folds: dict[str, Fold] = {}
    rest = _without_loops(expression.tree, items, expression, folds)
    kinds = {**expression.kinds, **{name: _KINDS[fold.kind] for name, fold in folds.items()}}
    return Folded(Part(rest, kinds, expression.result), folds)


def _without_loops(node: Node, items: str, whole: Expression, folds: dict[str, Fold]) -> Node:
    if (found := _found(node, items)) is not None:
        kind, variable, predicate, one = found
        part = None
        if predicate is not None:
            part = Part(predicate, {**whole.kinds, variable: CelType.DYN}, CelType.BOOL)
        name = f"fold{len(folds)}"
        while name in whole.kinds:
            name += "_"
        folds[name] = Fold(kind, variable, part)
        return Call("_==_", None, (Name(name), Scalar(1.0))) if one else Name(name)
    match node:
        case Call(function, None, arguments):
            return Call(function, None, tuple(_without_loops(each, items, whole, folds) for each in arguments))
        case Collection(is_map, elements):
            return Collection(is_map, tuple(_without_loops(each, items, whole, folds) for each in elements))
        case Select(operand, field, test_only):
            return Select(_without_loops(operand, items, whole, folds), field, test_only)
    return node


_Found = tuple[FoldKind, str, Node | None, bool]
"""The kind, the variable, the predicate, and whether the result is `count == 1`."""


def _found(node: Node, items: str) -> _Found | None:
    """The fold that is equivalent to a node; None if there is none."""
    match node:
        case Call("double", None, (Call("size", None, (counted,)),)):
            return _count(counted, items)
        case Call("double", None, (Call("size", Name() | Loop() as counted, ()),)):
            return _count(counted, items)
        case Loop(Name(over), (variable,), total, start, (stop, step), end) if over == items:
            return _of_loop(variable, total, start, stop, step, end)
    return None


def _count(counted: Node, items: str) -> _Found | None:
    match counted:
        case Name(name) if name == items:
            return FoldKind.COUNT, "", None, False
        case Loop(
            Name(over),
            (variable,),
            total,
            Collection(False, ()),
            (Scalar(True), Call("_?_:_", None, (predicate, Call("_+_", None, (Name(one), added)), Name(other)))),
            Name(result),
        ) if over == items and one == other == result == total and added == Collection(False, (Name(variable),)):
            return FoldKind.COUNT, variable, predicate, False
    return None


def _of_loop(variable: str, total: str, start: Node, stop: Node, step: Node, end: Node) -> _Found | None:
    so_far = Name(total)
    match start, step:
        case Scalar(False), Call("_||_", None, (before, predicate)) if (before, end) == (so_far, so_far):
            return FoldKind.ANY, variable, predicate, False
        case Scalar(True), Call("_&&_", None, (before, predicate)) if (before, end) == (so_far, so_far):
            return FoldKind.ALL, variable, predicate, False
        case Scalar(0), Call("_?_:_", None, (predicate, more, other)) if (
            other == so_far
            and stop == Scalar(True)
            and more == Call("_+_", None, (so_far, Scalar(1)))
            and end == Call("_==_", None, (so_far, Scalar(1)))
        ):
            return FoldKind.COUNT, variable, predicate, True
    return None
