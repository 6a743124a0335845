"""Internal functions that prepare an argument of CEL's functions; other types pass through unchanged."""

from __future__ import annotations

from typing import Final

from cel_expr_python import cel

from wayside.expressions.bounds import BOUNDED, LONGEST_INPUT
from wayside.expressions.functions.calls import Arguments, called_by_cel
from wayside.expressions.numbers import DIGITS, MAX_EXACT


def _bounded(arguments: Arguments) -> object:
    (text,) = arguments
    if isinstance(text, str) and len(text) * 4 > LONGEST_INPUT and (size := len(text.encode())) > LONGEST_INPUT:
        raise ValueError(f"matches takes strings of at most {LONGEST_INPUT} bytes; got {size}")
    return text


def _whole(arguments: Arguments) -> object:
    (number,) = arguments
    if isinstance(number, float) and abs(number) <= MAX_EXACT and number.is_integer():
        return int(number)
    return number


def _same(arguments: Arguments) -> object:
    return arguments[0]


def _passing(name: str, prepared: cel.Overload, others: tuple[cel.Type, ...]) -> cel.FunctionDecl:
    return cel.FunctionDecl(
        name,
        [prepared]
        + [
            cel.Overload(f"{name}_{kind.name().rsplit('.', 1)[-1].lower()}", kind, [kind], False, called_by_cel(_same))
            for kind in others
        ],
    )


_ALL: Final = (cel.Type.BOOL, cel.Type.INT, cel.Type.BYTES, cel.Type.TIMESTAMP, cel.Type.DURATION)

DECLARATIONS: Final = (
    _passing(
        DIGITS,
        cel.Overload(f"{DIGITS}_double", cel.Type.DYN, [cel.Type.DOUBLE], False, called_by_cel(_whole)),
        (cel.Type.STRING, *_ALL),  # not UINT: those are the handles of lists, maps and bytes
    ),
    _passing(
        BOUNDED,
        cel.Overload(f"{BOUNDED}_string", cel.Type.STRING, [cel.Type.STRING], False, called_by_cel(_bounded)),
        (cel.Type.DOUBLE, cel.Type.UINT, *_ALL),  # `matches` itself refuses these with an error
    ),
)
"""For `string`: a double without a fraction becomes an integer, so that `string(4711000)` is `4711000`. For `matches`:
a string that is too long is an error, without a search."""
