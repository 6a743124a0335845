"""Supervises watches: a watch without an event or bookmark is restarted; if that does not help, the manager is ended.

kopf has its own timeout for inactive watches, which can end them for good: its `asyncio.timeout` stays armed while
kopf's consumer, not the stream, is waiting. If it expires at that time, as after a stall of the process, it cancels the
consumer, and kopf treats that task as one that was meant to end. So kopf's timeout is set out of reach, and ours is
armed only while the manager waits for the stream. docs/decisions/0026 has the details.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from typing import Any

from kopf._cogs.clients import errors, watching
from prometheus_client.core import CounterMetricFamily, Metric
from prometheus_client.registry import Collector

from application_manager.measures import PREFIX, gauges

NEVER = 10 * 365 * 86400.0
"""Seconds: for kopf's own timeout."""

_LIMITS = 2  # multiple of the timeout after which the manager ends, while the API server answers

Watch = tuple[str, str]
"""Resource and namespace; empty: all."""

log = logging.getLogger(__name__)


class WatchHealth(Collector):
    """When each watch last gave a sign of life; also as metrics. Any thread may read it."""

    def __init__(self, limit: float, healthy: Callable[[], float]) -> None:
        """`limit`: seconds until a watch is restarted; `healthy`: seconds during which the API server responded."""
        self.limit = limit
        self._healthy = healthy
        self._beats: dict[Watch, tuple[float, float]] = {}  # monotonic and healthy seconds
        self._restarts = 0

    def beat(self, watch: Watch) -> None:
        """Note a sign of life."""
        self._beats[watch] = time.monotonic(), self._healthy()

    def forget(self, watch: Watch) -> None:
        """Note that the account may not watch the resource, which was reported at the start."""
        self._beats.pop(watch, None)

    def restarted(self, watch: Watch) -> None:
        """Note that a watch was silent for too long, and is restarted."""
        self._restarts += 1
        log.warning(
            "the watch of %s%s had no event or bookmark for %g s; restarting it",
            watch[0],
            f" in {watch[1]}" if watch[1] else "",
            self.limit,
        )

    def begun(self, resource: str) -> bool:
        """Whether a watch of the resource has started."""
        return any(each == resource for each, _ in self._beats.copy())

    def dead(self) -> str | None:
        """The watch that gave no sign of life for too long although the API server responded, as text."""
        now = self._healthy()
        for (resource, _), (_, since) in self._beats.copy().items():
            if now - since > _LIMITS * self.limit:
                return f"the watch of {resource} has had neither events nor bookmarks for {now - since:.0f} s"
        return None

    def collect(self) -> Iterator[Metric]:
        """The current metrics."""
        now, ages = time.monotonic(), dict[str, float]()
        for (resource, _), (since, _) in self._beats.copy().items():
            ages[resource] = max(ages.get(resource, 0.0), now - since)
        text = "Seconds since the last event or bookmark of the quietest watch"
        yield gauges("watch_age_seconds", text, "resource", sorted(ages.items()))
        text = "Watches that were restarted because they were silent"
        yield CounterMetricFamily(f"{PREFIX}watch_restarts", text, self._restarts)


@contextmanager
def supervising(health: WatchHealth) -> Iterator[None]:
    """Make kopf's watches report signs of life while the block runs, and restart those that report none."""
    original = watching.watch_objs

    async def watch_objs(*, resource: Any, namespace: Any, **more: Any) -> AsyncIterator[Any]:
        watch = (str(resource.plural), str(namespace or ""))
        stream = original(resource=resource, namespace=namespace, **more)
        health.beat(watch)
        while True:
            try:
                async with asyncio.timeout(health.limit):  # only while it waits for the stream
                    event = await anext(stream)
            except StopAsyncIteration:
                return
            except TimeoutError:
                health.restarted(watch)
                return
            except errors.APIForbiddenError:
                health.forget(watch)
                raise
            health.beat(watch)
            yield event

    watching.watch_objs = watch_objs
    try:
        yield
    finally:
        watching.watch_objs = original
