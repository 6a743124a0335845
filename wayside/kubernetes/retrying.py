"""Repeated requests to the API server: until it responds, or periodically."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import TypeVar

from wayside.kubernetes.connection import ConfigurationError
from wayside.kubernetes.errors import ApiError, RequestError
from wayside.process.backoff import Backoff, retry_async

_FAILURES = (RequestError, ConfigurationError)

FIRST_PAUSE, LONGEST_PAUSE = 1.0, 5.0  # s between two attempts, unless the API server requests more

Answer = TypeVar("Answer")

log = logging.getLogger(__name__)


async def until_answered(request: Callable[[], Awaitable[Answer]], pause: float = FIRST_PAUSE) -> Answer:
    """The response, however long it takes. Logs once that the API server is unavailable, overloaded or starting.

    Args:
        request: sends the request once.
        pause: seconds until the second attempt; further pauses grow.

    Raises:
        ApiError: an error that a retry cannot change, such as missing rights or credentials.
    """
    backoff = Backoff(pause, LONGEST_PAUSE)

    def failed(error: RequestError) -> float:
        if isinstance(error, ApiError) and (error.permanent or error.code == 401):
            raise error
        if not backoff.failures:
            log.warning("%s; retrying until the API server responds", error)
        return max(backoff.fail(), error.retry_after or 0.0)

    answer = await retry_async(request, RequestError, failed)
    if backoff.failures:
        log.info("the API server responds")
    return answer


async def repeatedly(attempt: Callable[[], Awaitable[object]], every: float, problem: str) -> None:
    """Call `attempt` periodically, until cancelled. Each reason of failure is logged once.

    Args:
        attempt: one attempt.
        every: seconds between two calls, unless the API server requests more.
        problem: the problem, for the log; empty if failures are reported elsewhere.
    """
    reported = ""

    async def once() -> float:
        """Call it once; the seconds until the next call."""
        nonlocal reported
        try:
            await attempt()
        except _FAILURES as error:
            if problem and str(error) != reported:
                log.warning("%s: %s", problem, error)
            reported = str(error)
            return max(every, (error.retry_after or 0.0) if isinstance(error, RequestError) else 0.0)
        reported = ""
        return every

    while True:
        pause = await once()
        await asyncio.sleep(pause)
