"""A cache of the worker processes' answers, filled in the background.

A caller whose answer is missing gets None, and a callback once it is there. Nobody waits, so a slow expression holds no
worker of a queue. Each key has one entry, for its latest question. Beyond a number of bytes, the cache drops the least
recently used entries, and computes them again when they are next requested.
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

KEPT = 64 * 1024 * 1024  # bytes of answers
FIRST_PAUSE = 60.0  # s until what was ended is tried again, doubled with each further time
LONGEST_PAUSE = 3600.0  # s

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Exceeded:
    """The answer to a question whose job was ended; the text names the limit."""

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
    """Takes questions. Only the event loop's thread uses it."""

    def __init__(self, pool: Pool, kept: int = KEPT) -> None:
        """`kept`: bytes of answers that are kept."""
        self._pool = pool
        self._limit = kept
        self._size = 0
        self._kept: OrderedDict[Hashable, _Kept] = OrderedDict()
        self._requested: dict[Hashable, asyncio.Task[None]] = {}

    def answer(
        self, key: Hashable, question: object, namespace: str, job: Callable[[], Job[object]], done: Callable[[], None]
    ) -> object | None:
        """The answer, `Exceeded` where it takes too long; None at first, and then `done` is called once it is there.

        Args:
            key: the object that it is about.
            question: what the answer follows from; compared with that of the answer that is there.
            namespace: whose CPU time it takes.
            done: called once, however the job ends; who still wants the answer requests it again.
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
        """Drop the answer of an object that is deleted."""
        known = self._kept.pop(key, None)
        if known is not None:
            self._size -= known.size

    async def close(self) -> None:
        """End all work."""
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
