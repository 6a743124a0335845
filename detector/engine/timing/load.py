"""When the machine is too slow: which rules are evaluated less often, in which order. Pure; the level is given.

Each class of rules with one priority, from the lowest on, is thinned out in three steps: every second evaluation, every
fourth, every eighth. The next class begins when the one below it is at its last step. At level 0 no
evaluation is left out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

STEPS = (1, 2, 4, 8)
"""By level: one in this number of evaluations takes place."""


def highest_level(priorities: Collection[int]) -> int:
    """The level beyond which nothing more can be left out."""
    return len(set(priorities)) * (len(STEPS) - 1)


def thinning(level: int, priorities: Collection[int]) -> Mapping[int, int]:
    """Of how many evaluations one takes place, by the rules' priority."""
    found = {}
    for priority in sorted(set(priorities)):
        step = min(level, len(STEPS) - 1)
        found[priority] = STEPS[step]
        level -= step
    return found
