"""Numbers in expressions: doubles, except that integers beyond a double's precision stay integers."""

from __future__ import annotations

EXACT = 2**53
"""Every integer up to this one is a double."""


def as_double(value: int) -> float | int:
    """The integer as a double if that is exact, otherwise unchanged."""
    return float(value) if -EXACT <= value <= EXACT else value
