"""Detects when the evaluation falls behind or has caught up: the level of thinning, from the duration of cycles. Pure.

A slow cycle means that ticks are overdue: the level rises by one at once. It falls by one after each ten seconds
without a slow cycle. `detector/engine/timing/schedule.py` defines the levels.
"""

from __future__ import annotations

LONG = 250_000_000
"""Maximum nanoseconds for the evaluation of one cycle; from 1 s on, ticks are lost."""

CALM = 10 * 10**9
"""Nanoseconds without a slow cycle after which the level falls by one."""


class Overload:
    """Tracks the duration of the evaluator's cycles."""

    def __init__(self) -> None:
        self.level = 0
        self._since = 0
        """When the last slow cycle, or the last step down, was."""

    def observe(self, now: int, spent: int, highest: int) -> bool:
        """A cycle ended `now` that took `spent` nanoseconds; returns whether the level changed.

        `highest`: the level at which thinning reaches its maximum.
        """
        before = self.level = min(self.level, highest)
        if spent > LONG:
            self._since = now
            self.level = min(self.level + 1, highest)
        elif self.level and now - self._since >= CALM:
            self._since = now
            self.level -= 1
        return self.level != before
