"""Numbers as expressions want them: doubles, but integers that a double cannot hold exactly stay integers."""

from __future__ import annotations

EXACT = 2**53
"""Up to here, every integer is a double."""


def number(value: int) -> float | int:
    """The integer as a double where that is exact enough, else as it is."""
    return float(value) if -EXACT <= value <= EXACT else value
