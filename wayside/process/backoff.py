"""Retry with backoff: exponential, with jitter."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

Failure = TypeVar("Failure", bound=BaseException)
Result = TypeVar("Result")

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


def retry(
    attempt: Callable[[], Result],
    failure: type[Failure],
    failed: Callable[[Failure], float],
    sleep: Callable[[float], object] = time.sleep,
) -> Result:
    """The result of the first attempt that does not fail.

    Args:
        attempt: returns the result, also where nothing is wanted any more.
        failure: what an attempt may raise to be repeated; all else is raised.
        failed: handles a failure; returns the seconds until the next attempt. What it raises is raised.
        sleep: waits that many seconds; may return earlier.
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
