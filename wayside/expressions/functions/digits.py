"""Whole numbers are written with all their digits, although they are doubles: `string(4711000)` is `4711000`."""

from __future__ import annotations

from typing import Final

from cel_expr_python import cel

from wayside.expressions.functions.calls import Arguments, called_by_cel
from wayside.expressions.numbers import DIGITS, MAX_EXACT

_OTHERS: Final = (
    cel.Type.STRING, cel.Type.BOOL, cel.Type.INT, cel.Type.BYTES, cel.Type.TIMESTAMP, cel.Type.DURATION,
)  # fmt: skip
"""Not UINT: those are the handles of lists, maps and bytes."""


def _whole(arguments: Arguments) -> object:
    (number,) = arguments
    if isinstance(number, float) and abs(number) <= MAX_EXACT and number.is_integer():
        return int(number)
    return number


def _same(arguments: Arguments) -> object:
    return arguments[0]


DECLARATION: Final = cel.FunctionDecl(
    DIGITS,
    [cel.Overload(f"{DIGITS}_double", cel.Type.DYN, [cel.Type.DOUBLE], False, called_by_cel(_whole))]
    + [
        cel.Overload(f"{DIGITS}_{kind.name().rsplit('.', 1)[-1].lower()}", kind, [kind], False, called_by_cel(_same))
        for kind in _OTHERS
    ],
)
"""Prepares a value for `string`: a double without a fraction becomes an integer, any other value is unchanged."""
