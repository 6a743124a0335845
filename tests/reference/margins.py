"""The margin of a condition, from its text parsed as Python."""

from __future__ import annotations

import ast
from typing import Any

from tests.reference.aggregates import NOTHING
from tests.reference.signals import evaluated

_NAMES = {"&&": " and ", "||": " or ", "!(": " not ("}


def margin(when: str, scales: dict[str, float], variables: dict[str, Any], names: tuple[str, ...]) -> Any:
    """The robustness; NOTHING where a comparison is unknown."""
    for theirs, ours in _NAMES.items():
        when = when.replace(theirs, ours)

    def of(node: ast.expr) -> Any:
        match node:
            case ast.BoolOp(op, values):
                parts = [of(value) for value in values]
                extreme = min if isinstance(op, ast.And) else max
                return NOTHING if NOTHING in parts else extreme(parts)
            case ast.UnaryOp(ast.Not(), operand):
                inner = of(operand)
                return NOTHING if inner is NOTHING else -inner
            case ast.Compare(left, [op], [right]):
                read = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
                read |= {each.attr for each in ast.walk(node) if isinstance(each, ast.Attribute)}
                scale = next((scales[name] for name in sorted(read & scales.keys())), 1.0)
                difference = evaluated(f"({ast.unparse(left)}) - ({ast.unparse(right)})", variables, names)
                if difference is NOTHING or not isinstance(difference, float):
                    return NOTHING
                if isinstance(op, ast.Lt | ast.LtE):
                    difference = 0.0 - difference
                if isinstance(op, ast.Eq | ast.NotEq):
                    difference = -abs(difference) if isinstance(op, ast.Eq) else abs(difference)
                return difference / scale
        raise ValueError(ast.dump(node))

    return of(ast.parse(when.strip(), mode="eval").body)
