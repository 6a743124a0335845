"""Retry with backoff: exponential, with jitter."""

from __future__ import annotations

import random

_DOUBLINGS = 30  # beyond them every pause has its cap


def pause_after(failures: int, first: float, longest: float) -> float:
    """Seconds to wait after failures in a row: `first` doubled with each further one, up to `longest`.

    With jitter: between half and all of it.
    """
    whole = min(longest, first * 2.0 ** min(failures - 1, _DOUBLINGS))
    return whole * random.uniform(0.5, 1.0)  # noqa: S311  no secret


class Backoff:
    """The pauses after the failures of one thing."""

    def __init__(self, first: float, cap: float) -> None:
        """Seconds: the pause after the first failure, and the longest one."""
        self._first = first
        self._cap = cap
        self.failures = 0
        """Failures since the last success."""

    def fail(self, at_least: float = 0.0) -> float:
        """Count a failure; the seconds to wait now.

        Args:
            at_least: seconds that the other side requests; limited by the cap.
        """
        self.failures += 1
        return min(self._cap, max(at_least, pause_after(self.failures, self._first, self._cap)))

    def succeed(self) -> None:
        """Start over: the next failure waits the first pause."""
        self.failures = 0
