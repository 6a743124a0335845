"""Retry with backoff: exponential, with jitter."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

Failure = TypeVar("Failure", bound=BaseException)
Result = TypeVar("Result")

_DOUBLINGS = 30  # beyond these, every pause has reached its cap


def pause_after(failures: int, first: float, longest: float) -> float:
    """Seconds to wait after consecutive failures: `first`, doubled with each further failure, up to `longest`.

    With jitter: between half of this time and all of it.
    """
    whole = min(longest, first * 2.0 ** min(failures - 1, _DOUBLINGS))
    return whole * random.uniform(0.5, 1.0)  # noqa: S311  no secret


class Backoff:
    """The pauses after consecutive failures of one operation."""

    def __init__(self, first: float, cap: float) -> None:
        """Seconds: the pause after the first failure, and the longest one."""
        self._first = first
        self._cap = cap
        self.failures = 0
        """Failures since the last success."""

    def fail(self, at_least: float = 0.0) -> float:
        """Count a failure. Returns the seconds to wait now.

        Args:
            at_least: the seconds that the other side requests; limited by the cap.
        """
        self.failures += 1
        return min(self._cap, max(at_least, pause_after(self.failures, self._first, self._cap)))

    def succeed(self) -> None:
        """Reset: the next failure has the first pause again."""
        self.failures = 0


def retry(
    attempt: Callable[[], Result],
    failure: type[Failure],
    failed: Callable[[Failure], float],
    sleep: Callable[[float], object] = time.sleep,
) -> Result:
    """The result of the first attempt that does not fail.

    Args:
        attempt: returns the result, or anything once the result is no longer needed.
        failure: the type of exception that is retried; any other exception is raised.
        failed: handles a failure, and returns the seconds until the next attempt. It may raise to end the retries.
        sleep: waits for this number of seconds; it may return earlier.
    """
    while True:
        try:
            return attempt()
        except failure as error:
            pause = failed(error)
        sleep(pause)


async def retry_async(
    attempt: Callable[[], Awaitable[Result]],
    failure: type[Failure],
    failed: Callable[[Failure], float],
    sleep: Callable[[float], Awaitable[object]] = asyncio.sleep,
) -> Result:
    """As `retry`, on the event loop."""
    while True:
        try:
            return await attempt()
        except failure as error:
            pause = failed(error)
        await sleep(pause)
