"""Worker processes: calls go in, results come out. A process that dies takes no other call with it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, NamedTuple, Protocol

ATTEMPTS = 2
"""In the company of others. A process that dies may have been killed for what another one does."""


class RemoteCall(NamedTuple):
    """A function of a module, and what it is called with; both travel to another process."""

    function: Callable[[Any], Any]
    argument: Any


@dataclass(frozen=True)
class Lost:
    """In place of a result: the process died each time."""

    reason: str


class Workers(Protocol):
    """Where calls run."""

    @property
    def count(self) -> int:
        """How many calls run side by side."""

    def run(self, calls: Iterable[RemoteCall]) -> Iterator[tuple[RemoteCall, Any]]:
        """Each call with its result, or `Lost`, in the order in which they are ready.

        An error that a call raises is raised here.
        """

    def close(self) -> None:
        """Nothing more is called."""


class LocalWorkers:
    """Processes of this machine."""

    def __init__(self, processes: int) -> None:
        """`processes` is how many there are at most, at least one; they start when they are needed."""
        self._processes = processes
        self._executor: ProcessPoolExecutor | None = None

    @property
    def count(self) -> int:
        """See `Workers`."""
        return self._processes

    def run(self, calls: Iterable[RemoteCall]) -> Iterator[tuple[RemoteCall, Any]]:
        """See `Workers`. A process that dies breaks its pool: what was under way begins again in another one.

        A call that was under way that often runs alone, so that it is known which one it is that kills its process.
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
                    result = Lost("its process was killed, e.g. for lack of memory: mine with fewer processes")
                yield call, result

    def close(self) -> None:
        """See `Workers`."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
            self._executor = None

    def _run(self, left: deque[tuple[RemoteCall, int]], alone: list[RemoteCall]) -> Iterator[tuple[RemoteCall, Any]]:
        """Until a process dies, or nothing is left."""
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
    # A fork would copy the locks of threads as they are; a spawned process has nothing of ours.
    return ProcessPoolExecutor(processes, mp_context=get_context("spawn"))
