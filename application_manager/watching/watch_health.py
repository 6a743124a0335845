"""Supervises watches: one without an event or a bookmark is restarted, or the manager is ended.

kopf has a timeout of its own for inactive watches, and it can kill them: its `asyncio.timeout` stays armed while kopf's
consumer, and not the stream, is waiting. Expired there, as after a stall of the process, it cancels the consumer, and
kopf takes that task as one that was meant to end. So that timeout is out of the way here, and ours is armed only while
the stream is waited for. docs/decisions/0026 has the details.
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
    """When each watch last gave a sign of life; also as metrics. Any thread may read."""

    def __init__(self, limit: float, healthy: Callable[[], float]) -> None:
        """`limit`: seconds until a watch is restarted; `healthy`: seconds during which the API server answered."""
        self.limit = limit
        self._healthy = healthy
        self._beats: dict[Watch, tuple[float, float]] = {}  # monotonic and healthy seconds
        self._restarts = 0

    def beat(self, watch: Watch) -> None:
        """A sign of life."""
        self._beats[watch] = time.monotonic(), self._healthy()

    def forget(self, watch: Watch) -> None:
        """The account may not watch it, which was reported at the start."""
        self._beats.pop(watch, None)

    def restarted(self, watch: Watch) -> None:
        """A watch was silent for too long and is begun again."""
        self._restarts += 1
        log.warning(
            "the watch of %s%s had no event or bookmark for %g s; restarting it",
            watch[0],
            f" in {watch[1]}" if watch[1] else "",
            self.limit,
        )

    def begun(self, resource: str) -> bool:
        """Whether a watch of the resource has begun."""
        return any(each == resource for each, _ in self._beats.copy())

    def dead(self) -> str | None:
        """The watch that has had no sign of life for too long while the API server answered, in words."""
        now = self._healthy()
        for (resource, _), (_, since) in self._beats.copy().items():
            if now - since > _LIMITS * self.limit:
                return f"the watch of {resource} has had neither events nor bookmarks for {now - since:.0f} s"
        return None

    def collect(self) -> Iterator[Metric]:
        """The metrics as of now."""
        now, ages = time.monotonic(), dict[str, float]()
        for (resource, _), (since, _) in self._beats.copy().items():
            ages[resource] = max(ages.get(resource, 0.0), now - since)
        text = "Seconds since the last event or bookmark of the quietest watch"
        yield gauges("watch_age_seconds", text, "resource", sorted(ages.items()))
        text = "Watches that were restarted because they were silent"
        yield CounterMetricFamily(f"{PREFIX}watch_restarts", text, self._restarts)


@contextmanager
def pulsing(pulse: WatchHealth) -> Iterator[None]:
    """Have kopf's watches give their signs of life while the block runs, and restart those that give none."""
    original = watching.watch_objs

    async def watch_objs(*, resource: Any, namespace: Any, **more: Any) -> AsyncIterator[Any]:
        watch = (str(resource.plural), str(namespace or ""))
        stream = original(resource=resource, namespace=namespace, **more)
        pulse.beat(watch)
        while True:
            try:
                async with asyncio.timeout(pulse.limit):  # only while the stream is waited for
                    event = await anext(stream)
            except StopAsyncIteration:
                return
            except TimeoutError:
                pulse.restarted(watch)
                return
            except errors.APIForbiddenError:
                pulse.forget(watch)
                raise
            pulse.beat(watch)
            yield event

    watching.watch_objs = watch_objs
    try:
        yield
    finally:
        watching.watch_objs = original
