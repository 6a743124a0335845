"""Exponential backoff with jitter."""

from __future__ import annotations

import random


class Backoff:
    """Delays that double from failure to failure up to a cap, each between half and all of its value."""

    def __init__(self, first: float, cap: float) -> None:
        """Seconds: the delay after the first failure, and the longest one."""
        self._first = first
        self._cap = cap
        self.failures = 0
        """Failures since the last success."""

    def fail(self, at_least: float = 0.0) -> float:
        """Count a failure; the seconds to wait now.

        Args:
            at_least: seconds that the other side requests; limited by the cap.
        """
        delay = min(self._cap, self._first * 2.0 ** min(self.failures, 30))
        self.failures += 1
        return min(self._cap, max(at_least, delay * random.uniform(0.5, 1.0)))  # noqa: S311  no secret

    def succeed(self) -> None:
        """Start over: the next failure waits the first delay."""
        self.failures = 0
