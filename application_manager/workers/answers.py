"""A cache of the worker processes' results, filled in the background.

A caller whose result is missing gets None, and a callback once it is available. No caller waits, so a slow expression
blocks no worker of a queue. Each key has one entry, for its latest input. Beyond a number of bytes, the cache drops the
least recently used entries, and computes them again when they are next requested.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass

from application_manager.workers.pool import ExceededError, JobError, Pool, unpickled
from application_manager.workers.process import Job
from wayside.process.backoff import pause_after

KEPT = 64 * 1024 * 1024  # bytes of results
FIRST_PAUSE = 60.0  # s until a stopped job is tried again, doubled with each further time
LONGEST_PAUSE = 3600.0  # s

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Exceeded:
    """The result of a request whose job was stopped; the text names the limit."""

    message: str


@dataclass(slots=True)
class _Kept:
    question: object
    answer: bytes | Exceeded
    until: float = float("inf")  # on the monotonic clock
    times: int = 0

    @property
    def size(self) -> int:
        return len(self.answer) if isinstance(self.answer, bytes) else 200


class AnswerCache:
    """Requests results. Only the event loop's thread uses it."""

    def __init__(self, pool: Pool, kept: int = KEPT) -> None:
        """`kept`: the maximum bytes of results to keep."""
        self._pool = pool
        self._limit = kept
        self._size = 0
        self._kept: OrderedDict[Hashable, _Kept] = OrderedDict()
        self._requested: dict[Hashable, asyncio.Task[None]] = {}

    def answer(
        self, key: Hashable, question: object, namespace: str, job: Callable[[], Job[object]], done: Callable[[], None]
    ) -> object | None:
        """The result, `Exceeded` if it exceeds its limits; None while it is computed, after which `done` is called.

        Args:
            key: the object that it concerns.
            question: the input; the cached result is returned if it has the same one.
            namespace: the CPU time is counted for it.
            done: called once, however the job ends; callers that still need the result request it again.
        """
        known = self._kept.get(key)
        if known is not None and known.question == question and time.monotonic() < known.until:
            self._kept.move_to_end(key)
            return known.answer if isinstance(known.answer, Exceeded) else unpickled(known.answer)
        if key not in self._requested:
            work = self._work(key, question, namespace, job(), done)
            self._requested[key] = asyncio.create_task(work, name="answer of a worker process")
        return None

    def forget(self, key: Hashable) -> None:
        """Forget the result of an object that was deleted."""
        known = self._kept.pop(key, None)
        if known is not None:
            self._size -= known.size

    async def close(self) -> None:
        """Stop all work."""
        tasks = list(self._requested.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _work(
        self, key: Hashable, question: object, namespace: str, job: Job[object], done: Callable[[], None]
    ) -> None:
        try:
            answer: bytes | Exceeded = await self._pool.answer(namespace, job)
        except ExceededError as error:
            answer = Exceeded(str(error))
        except JobError as error:
            log.error("%s: %s; retrying", key, error)
            await asyncio.sleep(1.0)
            del self._requested[key]
            done()
            return
        self._keep(key, question, answer)
        del self._requested[key]
        done()

    def _keep(self, key: Hashable, question: object, answer: bytes | Exceeded) -> None:
        before = self._kept.get(key)
        kept = _Kept(question, answer)
        if isinstance(answer, Exceeded):
            kept.times = before.times + 1 if before is not None and before.question == question else 1
            kept.until = time.monotonic() + pause_after(kept.times, FIRST_PAUSE, LONGEST_PAUSE)
        self.forget(key)
        self._kept[key] = kept
        self._size += kept.size
        while self._size > self._limit and len(self._kept) > 1:
            self.forget(next(iter(self._kept)))
