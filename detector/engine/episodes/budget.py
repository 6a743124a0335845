"""The maximum number of episodes per client and hour, for rules that set one."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

HOUR = 3_600 * 10**9
"""Nanoseconds."""

_FLEET = ""
"""Stands in for a client if a subject names none: no client has an empty name."""


class Budget:
    """Counts the starts of the last hour by client. An episode of a pair counts for both clients."""

    def __init__(self) -> None:
        self._starts: dict[str, deque[int]] = {}

    def takes(self, clients: Sequence[str], now: int, limit: int) -> bool:
        """Whether each of the clients had fewer than `limit` starts in (now - 1 h, now]; if so, count this one."""
        names = clients or (_FLEET,)
        for name in names:
            starts = self._starts.get(name)
            while starts and starts[0] <= now - HOUR:
                starts.popleft()
            if starts and len(starts) >= limit:
                return False
        for name in names:
            self._starts.setdefault(name, deque()).append(now)
        return True

    def expire(self, now: int) -> None:
        """Forget clients without starts in the last hour."""
        for name in [name for name, starts in self._starts.items() if not starts or starts[-1] <= now - HOUR]:
            del self._starts[name]
