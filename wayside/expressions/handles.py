"""Handles for values that CEL passes on unread: bytes always, lists and maps if a function takes them as they are.

CEL cuts bytes at NUL and converts lists item by item, which an image or a thousand objects do not survive in time. So
they enter an expression as a handle: a uint that no field can be taken of, that has no size, and that only the
functions of `functions` turn back into the value. Handles are good for the evaluation that made them.
"""

from __future__ import annotations

import threading
from typing import Final

_FIRST: Final = 2**63 + 2**62
"""Beyond every integer that a double holds: expressions yield no other uint of this size."""


class _Held(threading.local):
    """The values of the evaluation that runs on this thread; None while none does."""

    values: list[object] | None = None


_held = _Held()


def begin() -> list[object] | None:
    """An evaluation begins: `hand` hands out handles, `value_of` takes them. Returns what `end` is to be given.

    Two functions and no context manager: this is the path of every evaluation.
    """
    before, _held.values = _held.values, []
    return before


def end(before: list[object] | None) -> None:
    """The evaluation has ended; an enclosing one continues."""
    _held.values = before


def hand(value: object) -> int | None:
    """A handle for the value; None outside an evaluation."""
    values = _held.values
    if values is None:
        return None
    values.append(value)
    return _FIRST + len(values) - 1


def value_of(handle: object) -> object:
    """The value behind a handle; whatever is none is itself."""
    values = _held.values
    if values and isinstance(handle, int) and _FIRST <= handle < _FIRST + len(values):
        return values[handle - _FIRST]
    return handle
