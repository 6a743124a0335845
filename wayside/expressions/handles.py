"""Handles for values that CEL passes on without reading them: bytes, and lists and maps that are function arguments.

CEL truncates bytes at NUL, and converts lists item by item, which takes too long for an image or a thousand objects. So
such a value enters an expression as a handle: a uint without fields and size, which only the functions of `functions`
resolve to the value. A handle is valid only in the evaluation that created it.
"""

from __future__ import annotations

import threading
from typing import Final

_FIRST: Final = 2**63 + 2**62
"""Greater than every exact integer of a double: no expression yields another uint of this size."""


class _Held(threading.local):
    """The values of the current evaluation on this thread; None outside of one."""

    values: list[object] | None = None


_held = _Held()


def begin() -> list[object] | None:
    """Begin an evaluation: `handle_of` creates handles, `value_of` resolves them. Returns the argument for `end`.

    Two functions instead of a context manager, since every evaluation calls them.
    """
    before, _held.values = _held.values, []
    return before


def end(before: list[object] | None) -> None:
    """End the evaluation; an enclosing one continues."""
    _held.values = before


def handle_of(value: object) -> int | None:
    """A handle for the value; None outside an evaluation."""
    values = _held.values
    if values is None:
        return None
    values.append(value)
    return _FIRST + len(values) - 1


def value_of(handle: object) -> object:
    """The value of a handle; any other value is returned unchanged."""
    values = _held.values
    if values and isinstance(handle, int) and _FIRST <= handle < _FIRST + len(values):
        return values[handle - _FIRST]
    return handle
