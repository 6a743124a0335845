"""How fast we ask: so many requests at once, and none while the API server wants to be left alone.

A request that waits here has not begun, so its own time limit does not count yet. What waits is bounded by those who
ask: the workers of the queues, each with the objects of one instance.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

AT_ONCE = 24
"""Requests that are under way at the same time, of all queues together; watches are apart."""

LONGEST_HOLD = 60.0
"""Seconds that an API server's wish to be left alone is respected at the most."""


class Pacing:
    """Lets requests begin."""

    def __init__(self, at_once: int = AT_ONCE) -> None:
        self._places = asyncio.Semaphore(at_once)
        self._held_until = 0.0  # on the monotonic clock

    @property
    def held(self) -> float:
        """For how many seconds no request begins."""
        return max(0.0, self._held_until - time.monotonic())

    def hold(self, seconds: float) -> None:
        """Let no request begin for so long, as the API server asked us to; a shorter wish shortens no longer one."""
        self._held_until = max(self._held_until, time.monotonic() + min(seconds, LONGEST_HOLD))

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for a place, and for the end of a hold; the request runs within the block."""
        async with self._places:
            while (left := self.held) > 0:  # noqa: ASYNC110  it may be prolonged meanwhile
                await asyncio.sleep(left)
            yield
