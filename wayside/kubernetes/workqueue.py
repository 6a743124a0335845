"""A work queue of keys: processed concurrently, each by at most one worker at a time, and retried on failure.

Namespaces take turns, and with a `share`, none can occupy all workers. So a flood of keys in one namespace does not
delay the others.

A key that is added while it waits is queued only once; if it is added while a worker processes it, it is processed once
more afterwards. So the queue never has more entries than there are objects, and needs no other bound. A failed key is
retried with exponential backoff and jitter, or after the time that the API server requests.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Hashable
from contextlib import suppress
from typing import Any, Generic, Protocol, TypeVar

from wayside.kubernetes.errors import NotGranted, RequestError
from wayside.kubernetes.pacing import FairQueue
from wayside.process.backoff import pause_after

Key = TypeVar("Key", bound=Hashable)

FIRST_PAUSE = 0.2  # s, doubled with every failure of the key
LONGEST_PAUSE = 10.0  # s
_TURN = 0.05  # s between two checks whether the queue with precedence has keys of a namespace
_YIELDING = 0.25  # s that a worker waits for the keys of a namespace in the queue with precedence
_SHORTEST_DELAY = 0.1  # s, so that a time that is almost reached causes no busy loop

log = logging.getLogger(__name__)


class Measure(Protocol):
    """Receives the duration of each reconciliation, in seconds, and whether it failed and is retried."""

    def __call__(self, queue: str, seconds: float, *, failed: bool) -> None:
        """Called when the work on one key of a queue has ended."""


class WorkQueue(Generic[Key]):
    """Runs `work(key)` for every key added, on `concurrency` workers.

    While keys of a namespace wait in the queue `after`, each worker processes at most four keys of that namespace per
    second.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[Key], Awaitable[None]],
        concurrency: int,
        after: WorkQueue[Any] | None = None,
        measure: Measure | None = None,
        share: int | None = None,
    ) -> None:
        """Create an empty queue.

        Args:
            name: for logs and metrics.
            work: reconciles a key.
            concurrency: the number of workers.
            after: the queue with precedence over this one.
            measure: receives the duration of each reconciliation.
            share: the maximum number of workers for one namespace; None: no limit.
        """
        self.name = name
        self._measure = measure
        self._after = after
        self._work = work
        self._concurrency = concurrency
        self._share = share
        self._waiting: FairQueue[Key] = FairQueue()
        self._busy_workers: Counter[str] = Counter()  # keys by namespace
        self._queued: set[Key] = set()
        self._processing: dict[Key, float] = {}  # and since when, on the monotonic clock
        self._dirty: set[Key] = set()
        self._failures: Counter[Key] = Counter()
        self._timers: dict[Key, asyncio.TimerHandle] = {}
        self._wake = asyncio.Event()
        self._idle = asyncio.Event()
        self._idle.set()
        self._ending = False

    @property
    def depth(self) -> tuple[int, int]:
        """The number of keys that wait for a worker, and of keys that wait for their time."""
        return len(self._queued), len(self._timers)

    def __len__(self) -> int:
        """The number of keys that wait for a worker or are being processed."""
        return len(self._queued) + len(self._processing)

    async def idle(self) -> None:
        """Wait until no key waits for a worker or is being processed; keys that wait for their time do not count."""
        await self._idle.wait()

    def stuck(self, limit: float) -> str | None:
        """A text about a key whose processing takes longer than `limit` seconds; None if there is none. Thread-safe."""
        now = time.monotonic()
        for key, began in list(self._processing.items()):
            if now - began > limit:
                return f"{self.name} {_text(key)} has been in progress for {now - began:.0f} s"
        return None

    def add(self, key: Key) -> None:
        """Enqueue the key."""
        if key in self._processing:
            self._dirty.add(key)
        elif key not in self._queued:
            self._queued.add(key)
            self._waiting.add(_namespace(key), key)
            self._wake.set()
            self._idle.clear()

    def add_at(self, key: Key, when: float) -> None:
        """Enqueue the key at `when`, in seconds since the epoch. Of several times for a key, the earliest counts."""
        self._add_after(key, max(_SHORTEST_DELAY, when - time.time()))

    def _add_after(self, key: Key, delay: float) -> None:
        loop = asyncio.get_running_loop()
        known = self._timers.get(key)
        if known is not None:
            if known.when() <= loop.time() + delay:
                return
            known.cancel()
        self._timers[key] = loop.call_later(delay, self._fire, key)

    def _fire(self, key: Key) -> None:
        self._timers.pop(key, None)
        self.add(key)

    def finish(self) -> None:
        """Start no further key: `run` returns once the keys in progress are done."""
        self._ending = True
        self._wake.set()

    async def run(self) -> None:
        """Work until cancelled or finished. After a cancellation, it can run again with the waiting keys."""
        try:
            async with asyncio.TaskGroup() as group:
                for index in range(self._concurrency):
                    group.create_task(self._worker(), name=f"{self.name} worker {index}")
        finally:
            for timer in self._timers.values():
                timer.cancel()
            self._timers.clear()

    async def _worker(self) -> None:
        while not self._ending:
            key = await self._take()
            if key is None:
                return
            self._queued.discard(key)
            self._processing[key] = time.monotonic()
            namespace = _namespace(key)
            self._busy_workers[namespace] += 1
            try:
                await self._once(key)
            finally:
                self._leave(key, namespace)
            _raise_lost_cancellation()

    def _leave(self, key: Key, namespace: str) -> None:
        """Note that the key is no longer being processed."""
        del self._processing[key]
        self._busy_workers[namespace] -= 1
        if not self._busy_workers[namespace]:
            del self._busy_workers[namespace]
        if self._share is not None:
            self._wake.set()  # another worker may have let this namespace wait
        if key in self._dirty:
            self._dirty.discard(key)
            self.add(key)
        if not len(self):
            self._idle.set()

    async def _take(self) -> Key | None:
        """Wait for the next key; None once the queue is finished."""
        yields_until = math.inf
        while not self._ending:
            key = self._waiting.next(lambda namespace: self._may(namespace) and not self._yields(namespace))
            if key is None and time.monotonic() > yields_until:
                key = self._waiting.next(self._may)
            if key is not None:
                return key
            yielding = self._after is not None and bool(self._waiting)
            yields_until = min(yields_until, time.monotonic() + _YIELDING) if yielding else math.inf
            self._wake.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(_TURN if yielding else None):
                    await self._wake.wait()
        return None

    def _may(self, namespace: str) -> bool:
        """Whether the namespace has fewer workers than its share."""
        return self._share is None or self._busy_workers[namespace] < self._share

    def _yields(self, namespace: str) -> bool:
        """Whether keys of the namespace wait in the queue with precedence."""
        return self._after is not None and namespace in self._after._waiting

    async def _once(self, key: Key) -> None:
        began, failed = time.monotonic(), True
        try:
            await self._work(key)
        except NotGranted:
            self._failures.pop(key, None)  # once the namespace is granted, all its keys are enqueued
        except RequestError as error:
            pause = self._pause(key, error.retry_after)
            log.warning("%s %s: %s; retrying in %.1f s", self.name, _text(key), error, pause)
            self._add_after(key, pause)
        except Exception:  # a defect in the work on one key must not stop the others: it is logged and retried
            pause = self._pause(key, None)
            log.exception("cannot reconcile %s %s; retrying in %.1f s", self.name, _text(key), pause)
            self._add_after(key, pause)
        else:
            failed = False
            self._failures.pop(key, None)
        if self._measure is not None:
            self._measure(self.name, time.monotonic() - began, failed=failed)

    def _pause(self, key: Key, at_least: float | None) -> float:
        self._failures[key] += 1
        return max(at_least or 0.0, pause_after(self._failures[key], FIRST_PAUSE, LONGEST_PAUSE))


def _raise_lost_cancellation() -> None:
    """Raise a cancellation that was lost: `gather` raises an error of one of its parts instead."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


def _namespace(key: object) -> str:
    """The namespace of a key: a (namespace, name), or a kind with such a name; empty for keys of another form."""
    match key:
        case (str(namespace), str()) | (_, (str(namespace), str())):
            return namespace
    return ""


def _text(key: object) -> str:
    return "/".join(map(str, key)) if isinstance(key, tuple) else str(key)
