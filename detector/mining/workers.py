"""Worker processes: calls go in, results come out. A process that dies fails no other call."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, NamedTuple, Protocol

ATTEMPTS = 2
"""Attempts beside other calls. A process that dies may have been killed because of another one."""


class RemoteCall(NamedTuple):
    """A function of a module, and its arguments; both are sent to another process."""

    function: Callable[[Any], Any]
    argument: Any


@dataclass(frozen=True)
class LostWorker:
    """Stands in for a result: the process died each time."""

    reason: str


class Workers(Protocol):
    """Runs calls."""

    @property
    def count(self) -> int:
        """How many calls run in parallel."""

    def run(self, calls: Iterable[RemoteCall]) -> Iterator[tuple[RemoteCall, Any]]:
        """Each call with its result, or `LostWorker`, as they become ready.

        An exception of a call is raised here.
        """

    def close(self) -> None:
        """No more calls follow."""


class LocalWorkers:
    """Processes on this machine."""

    def __init__(self, processes: int) -> None:
        """`processes` is the maximum number, at least one; they start on demand."""
        self._processes = processes
        self._executor: ProcessPoolExecutor | None = None

    @property
    def count(self) -> int:
        """See `Workers`."""
        return self._processes

    def run(self, calls: Iterable[RemoteCall]) -> Iterator[tuple[RemoteCall, Any]]:
        """See `Workers`. A process that dies breaks its pool: the running calls start again in a new pool.

        A call that was running in that many broken pools runs alone, to find out whether it kills its process.
        """
        left = deque((call, 0) for call in calls)
        alone: list[RemoteCall] = []
        while left:
            yield from self._run(left, alone)
        for call in alone:
            with _pool(1) as executor:
                try:
                    result = executor.submit(call.function, call.argument).result()
                except BrokenProcessPool:
                    result = LostWorker("its process was killed, e.g. for lack of memory: mine with fewer processes")
                yield call, result

    def close(self) -> None:
        """See `Workers`."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
            self._executor = None

    def _run(self, left: deque[tuple[RemoteCall, int]], alone: list[RemoteCall]) -> Iterator[tuple[RemoteCall, Any]]:
        """Run until a process dies, or nothing is left."""
        self._executor = executor = self._executor or _pool(self._processes)
        running: dict[Future[Any], tuple[RemoteCall, int]] = {}
        try:
            while left or running:
                while left and len(running) < self._processes:
                    call, attempts = left[0]
                    running[executor.submit(call.function, call.argument)] = call, attempts
                    left.popleft()
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    result = future.result()
                    yield running.pop(future)[0], result
        except BrokenProcessPool:
            self.close()
            for future, (call, attempts) in running.items():
                if future.exception() is None:
                    yield call, future.result()
                elif attempts + 1 < ATTEMPTS:
                    left.appendleft((call, attempts + 1))
                else:
                    alone.append(call)


def _pool(processes: int) -> ProcessPoolExecutor:
    # A fork would copy held locks of other threads; a spawned process starts clean.
    return ProcessPoolExecutor(processes, mp_context=get_context("spawn"))
