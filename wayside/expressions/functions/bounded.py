"""Limits the input of `matches`: for a longer string the result is unknown, without a search."""

from __future__ import annotations

from typing import Final

from cel_expr_python import cel

from wayside.expressions.functions.calls import Arguments, called_by_cel
from wayside.expressions.regex import BOUNDED, LONGEST_INPUT

_OTHERS: Final = (
    cel.Type.DOUBLE, cel.Type.BOOL, cel.Type.INT, cel.Type.UINT, cel.Type.BYTES, cel.Type.TIMESTAMP, cel.Type.DURATION,
)  # fmt: skip
"""An input that `matches` itself refuses with an error."""


def _bounded(arguments: Arguments) -> object:
    (text,) = arguments
    if isinstance(text, str) and len(text) * 4 > LONGEST_INPUT and (size := len(text.encode())) > LONGEST_INPUT:
        raise ValueError(f"matches takes texts of at most {LONGEST_INPUT} bytes; got {size}")
    return text


def _same(arguments: Arguments) -> object:
    return arguments[0]


DECLARATION: Final = cel.FunctionDecl(
    BOUNDED,
    [cel.Overload(f"{BOUNDED}_string", cel.Type.STRING, [cel.Type.STRING], False, called_by_cel(_bounded))]
    + [
        cel.Overload(f"{BOUNDED}_{kind.name().rsplit('.', 1)[-1].lower()}", kind, [kind], False, called_by_cel(_same))
        for kind in _OTHERS
    ],
)
"""A text within the bound stays what it is."""
