"""At most two worker processes, shared by all namespaces: that with the least recent CPU time has precedence.

A namespace uses at most one of the two, so a template whose expressions take long delays others of its namespace and
leaves the second process to the other namespaces. A process starts when there is work for it, and one that was ended
for its CPU time is replaced immediately.
"""

from __future__ import annotations

import asyncio
import logging
import math
import pickle
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import Protocol, cast

from application_manager.measures import Measures
from application_manager.workers.child import Child, EndedError
from application_manager.workers.process import FAILED, Job, Result

PROCESSES = 2
CPU_TIME = 3.0
"""Seconds of CPU time that a job may take, by default."""

_ATTEMPTS = 2  # attempts of a job whose process ended for another reason than its CPU time
_FORGETTING = 30.0  # s after which the CPU time that a namespace has used counts half

log = logging.getLogger(__name__)


class ExceededError(Exception):
    """A job was stopped; the text names the limit."""


class JobError(Exception):
    """A job failed because of a defect of ours."""


@dataclass(eq=False, slots=True)
class _Ticket:
    namespace: str
    job: bytes
    answer: asyncio.Future[bytes]
    attempts: int = 0


class Runs(Protocol):
    """Runs jobs."""

    async def run(self, namespace: str, job: Job[Result]) -> Result:
        """The job's result. Raises ExceededError if it was stopped for exceeding its limits."""


class Pool:
    """Runs jobs. Only the event loop's thread uses it.

    The number of waiting jobs is limited by their callers: each object of the cluster, and each review, has one job.
    """

    def __init__(self, measures: Measures, cpu_time: float = CPU_TIME) -> None:
        """`cpu_time`: seconds that a job may take."""
        self.cpu_time = cpu_time
        self._measures = measures
        self._waiting: dict[str, deque[_Ticket]] = {}
        self._running: Counter[str] = Counter()
        self._used: dict[str, tuple[float, float]] = {}  # by namespace: seconds of CPU time, and as of when
        self._open: set[asyncio.Future[bytes]] = set()
        self._idle: list[Child] = []
        self._workers: set[asyncio.Task[None]] = set()
        self._closed = False

    async def run(self, namespace: str, job: Job[Result]) -> Result:
        """The job's result, computed in another process.

        Raises ExceededError if the job was stopped for exceeding its limits, and JobError if it raised an error.
        """
        return cast("Result", unpickled(await self.answer(namespace, job)))

    async def answer(self, namespace: str, job: Job[object]) -> bytes:
        """The pickled result, for `unpickled`. Raises the same."""
        if self._closed:
            raise asyncio.CancelledError
        job_bytes = pickle.dumps(job, pickle.HIGHEST_PROTOCOL)
        ticket = _Ticket(namespace, job_bytes, asyncio.get_running_loop().create_future())
        self._waiting.setdefault(namespace, deque()).append(ticket)
        self._open.add(ticket.answer)
        ticket.answer.add_done_callback(self._open.discard)
        self._dispatch()
        return await ticket.answer

    async def close(self) -> None:
        """End all processes at once; all jobs are cancelled."""
        self._closed = True
        for answer in self._open:
            answer.cancel()
        self._waiting.clear()
        for worker in self._workers:
            worker.cancel()
        await asyncio.gather(*self._workers, return_exceptions=True)
        await asyncio.gather(*(child.close() for child in self._idle))
        self._idle.clear()

    def _dispatch(self) -> None:
        """Start the jobs that may run."""
        while not self._closed and len(self._workers) < PROCESSES:
            ticket = self._next()
            if ticket is None:
                return
            self._running[ticket.namespace] += 1
            worker = asyncio.create_task(self._work(ticket), name="worker process")
            self._workers.add(worker)
            worker.add_done_callback(self._ended)

    def _ended(self, worker: asyncio.Task[None]) -> None:
        self._workers.discard(worker)
        if not worker.cancelled() and worker.exception() is not None:
            log.error("cannot use a worker process: %s", worker.exception())
        self._dispatch()

    def _next(self) -> _Ticket | None:
        """The next job: of the namespace that has used the least CPU time, among those without a running job."""
        now = time.monotonic()
        for namespace in [each for each, tickets in self._waiting.items() if all(t.answer.done() for t in tickets)]:
            del self._waiting[namespace]  # its caller no longer waits
        free = [each for each in self._waiting if not self._running[each]]
        if not free:
            return None
        namespace = min(free, key=lambda each: self._lately(each, now))
        tickets = self._waiting[namespace]
        ticket = tickets.popleft()
        while ticket.answer.done():
            ticket = tickets.popleft()
        if not tickets:
            del self._waiting[namespace]
        return ticket

    def _lately(self, namespace: str, now: float) -> float:
        used, then = self._used.get(namespace, (0.0, now))
        return used * math.exp2((then - now) / _FORGETTING)

    def _charge(self, namespace: str, seconds: float) -> None:
        now = time.monotonic()
        self._used[namespace] = (self._lately(namespace, now) + seconds, now)
        if len(self._used) > 1000:  # namespaces without recent jobs
            self._used = {each: used for each, used in self._used.items() if self._lately(each, now) > 0.001}

    async def _work(self, ticket: _Ticket) -> None:
        """Run a job, and then further ones until there are none."""
        try:
            child = self._idle.pop() if self._idle else await Child.start(self.cpu_time)
            following: _Ticket | None = ticket
            while following is not None:
                ticket = following
                child = await self._do(ticket, child)
                self._running -= Counter((ticket.namespace,))
                following = self._next()
                if following is not None:
                    self._running[following.namespace] += 1
                    self._dispatch()  # this namespace may have been the last obstacle of another job
        except Exception as error:
            self._running -= Counter((ticket.namespace,))
            if not ticket.answer.done():
                ticket.answer.set_exception(JobError(f"cannot start a worker process: {error}"))
            raise
        self._idle.append(child)

    async def _do(self, ticket: _Ticket, child: Child) -> Child:
        """Run one job; returns the process for the next one."""
        began = time.monotonic()
        try:
            answer, used = await child.do(ticket.job)
        except EndedError as error:
            await child.close()
            ticket.attempts += 1
            self._charge(ticket.namespace, self.cpu_time)
            if not error.of_time and ticket.attempts < _ATTEMPTS:
                return await self._do(ticket, await Child.start(self.cpu_time))
            self._measures.job_exceeded()
            log.warning("namespace %s: a worker process %s", ticket.namespace, error)
            if not ticket.answer.done():
                ticket.answer.set_exception(ExceededError(self._text(error)))
            return await Child.start(self.cpu_time)
        except BaseException:
            await child.close()
            raise
        self._charge(ticket.namespace, max(0.0, used))
        self._measures.job_done(time.monotonic() - began)
        if ticket.answer.done():
            return child
        if used == FAILED:
            ticket.answer.set_exception(JobError(answer.decode()))
        else:
            ticket.answer.set_result(answer)
        return child

    def _text(self, error: EndedError) -> str:
        if error.of_time:
            return (
                f"took more than {self.cpu_time:g} s of CPU time and was stopped: simplify its expressions, above "
                "all loops and `matches`"
            )
        return f"was stopped, since its process {error}: simplify its expressions, or make their values smaller"


def unpickled(answer: bytes) -> object:
    """The result of a job."""
    result: object = pickle.loads(answer)  # noqa: S301  from a process of our own
    return result
