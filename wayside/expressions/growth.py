"""Bounds the size of an expression's result: a short expression could otherwise fill the memory.

CEL bounds how often a loop runs, and how deep an expression is nested, but not how large a value becomes:
`[text].map(a, a + a)[0]`, within itself and again, doubles it each time. So each literal and each variable counts as
one, what is put together counts as its parts do, and a loop's variable as what the loop runs over.
"""

from __future__ import annotations

from collections.abc import Mapping

from wayside.expressions.syntax import Call, Collection, Loop, Name, Node, Scalar, Select

MOST = 1000
"""The maximum number of copies of its parts in a value. Expressions in practice have a handful."""

_ONE_OF = ("_?_:_", "_[_]", "_[?_]")
_SCALARS = frozenset(
    {
        "_==_", "_!=_", "_<_", "_<=_", "_>_", "_>=_", "_&&_", "_||_", "!_", "@in", "@not_strictly_false", "-_", "_-_",
        "_*_", "_/_", "_%_", "size", "bool", "double", "int", "uint", "contains", "startsWith", "endsWith", "matches",
    }
)  # fmt: skip
"""Operators and functions whose result is always a number or a truth."""


def growth(node: Node) -> int:
    """The most copies of literals and variables that any value on the way may hold."""
    largest = 0

    def copies(node: Node, known: Mapping[str, int]) -> int:
        nonlocal largest
        found = max(1, weigh(node, known))
        largest = max(largest, found)
        return found

    def weigh(node: Node, known: Mapping[str, int]) -> int:
        match node:
            case Scalar():
                return 1
            case Name(name):
                return known.get(name, 1)
            case Select(operand, _, test_only):
                inner = copies(operand, known)
                return 1 if test_only else inner
            case Call(function, target, arguments):
                parts = [copies(each, known) for each in (*([] if target is None else [target]), *arguments)]
                if function in _SCALARS:
                    return 1
                return max(parts, default=1) if function in _ONE_OF else sum(parts)
            case Collection(_, elements):
                return sum(copies(each, known) for each in elements)
            case Loop(over, names, accumulator, initial, body, result):
                within = {**known, **dict.fromkeys(names, copies(over, known)), accumulator: copies(initial, known)}
                step = max((copies(each, within) for each in body), default=1)
                return copies(result, {**known, accumulator: step})

    copies(node, {})
    return largest
