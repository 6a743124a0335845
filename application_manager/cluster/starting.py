"""The start: what the manager cannot do without is asked for until the API server gives it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import TypeVar

from application_manager.cluster.errors import ApiError, Unreachable

PAUSE = 1.0  # s between two attempts, unless the API server asks for more

Answer = TypeVar("Answer")

log = logging.getLogger(__name__)


async def until_answered(ask: Callable[[], Awaitable[Answer]], pause: float = PAUSE) -> Answer:
    """The answer, however long it takes; that the API server is away, overloaded or starting is said once.

    Args:
        ask: asks once.
        pause: seconds between two attempts.

    Raises:
        ApiError: what asking again cannot change, such as rights or credentials that lack.
    """
    waiting = False
    while True:
        try:
            answer = await ask()
        except (ApiError, Unreachable) as error:
            if isinstance(error, ApiError) and (error.permanent or error.code == 401):
                raise
            if not waiting:
                log.warning("%s; asking again until the API server answers", error)
            waiting = True
            asked = error.retry_after if isinstance(error, ApiError) else None
            await asyncio.sleep(max(pause, asked or 0.0))
        else:
            if waiting:
                log.info("the API server answers")
            return answer
