"""Overload: which rules are evaluated less often, and in which order. Pure; the caller gives the level.

Each class of rules with the same priority, from the lowest, is thinned in three steps: every second evaluation, every
fourth, every eighth. The next class begins when the one below it has reached its last step. At level 0 no evaluation is
skipped.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

STEPS = (1, 2, 4, 8)
"""By level: one in this number of evaluations takes place."""


def highest_level(priorities: Collection[int]) -> int:
    """The level at which thinning reaches its maximum."""
    return len(set(priorities)) * (len(STEPS) - 1)


def thinning(level: int, priorities: Collection[int]) -> Mapping[int, int]:
    """By priority of the rules: one in this number of evaluations takes place."""
    found = {}
    for priority in sorted(set(priorities)):
        step = min(level, len(STEPS) - 1)
        found[priority] = STEPS[step]
        level -= step
    return found
