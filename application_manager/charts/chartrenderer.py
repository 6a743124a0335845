"""Renders charts in the background, and caches the results.

An instance whose chart is not rendered yet reports that, and is enqueued once the chart is rendered: no worker waits
for Helm. Charts do not affect each other: the number of concurrent runs of each source is limited, and a chart that
cannot be fetched, or takes too long, is retried with backoff.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from application_manager.charts.chartcache import ChartCache
from application_manager.charts.helm import HelmError, HelmRunner
from application_manager.core.objects.charts import (
    FAILED,
    UNAVAILABLE,
    ChartObjects,
    ChartOutcome,
    ChartRequest,
    ChartSource,
    parse_chart,
)
from application_manager.core.objects.ownership import ApplyProblem
from application_manager.core.objects.policy import Name
from wayside.process.backoff import pause_after

FIRST_PAUSE = 5.0  # s after a failure, doubled with each further one
LONGEST_PAUSE = 300.0  # s
KEPT = 2000  # renderings; the least recently requested are forgotten, and computed again on request
_RUNS = 6  # concurrent runs of helm
_RUNS_OF_ONE = 2  # of these for one source

log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Pause:
    """The backoff of something that failed; times by the monotonic clock."""

    failures: int = 0
    until: float = 0.0
    failure: ApplyProblem | None = None

    def fail(self, failure: ApplyProblem) -> None:
        self.failures += 1
        self.until = time.monotonic() + pause_after(self.failures, FIRST_PAUSE, LONGEST_PAUSE)
        self.failure = failure

    @property
    def left(self) -> float:
        return max(0.0, self.until - time.monotonic()) + 0.1

    @property
    def over(self) -> bool:
        return time.monotonic() >= self.until


@dataclass(slots=True)
class _Source:
    """One chart: whether it is available, and its runs."""

    pause: _Pause = field(default_factory=_Pause)
    runs: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(_RUNS_OF_ONE))
    fetching: asyncio.Lock = field(default_factory=asyncio.Lock)


@dataclass(slots=True)
class _Rendering:
    outcome: ChartOutcome | None = None
    pause: _Pause = field(default_factory=_Pause)
    work: asyncio.Task[None] | None = None


class ChartRenderer:
    """Renders charts in the background. Only the event loop's thread uses it."""

    def __init__(self, helm: HelmRunner, cache: ChartCache, enqueue_at: Callable[[Name, float], None]) -> None:
        """`enqueue_at` enqueues an instance at a time, in seconds since 1970."""
        self._helm = helm
        self._cache = cache
        self._enqueue_at = enqueue_at
        self._renderings: OrderedDict[ChartRequest, _Rendering] = OrderedDict()
        self._sources: dict[ChartSource, _Source] = {}
        self._runs = asyncio.Semaphore(_RUNS)

    def outcome(self, request: ChartRequest) -> ChartOutcome | None:
        """The result of the request; None while it is being rendered, after which the instance is enqueued.

        A failure is returned until a new attempt, after a pause, succeeds.
        """
        known = self._renderings.setdefault(request, _Rendering())
        self._renderings.move_to_end(request)
        if known.work is None and not isinstance(known.outcome, ChartObjects) and known.pause.over:
            known.work = asyncio.create_task(self._do(request, known), name=f"chart of {request.release}")
        if isinstance(known.outcome, ApplyProblem) and known.work is None:
            self._enqueue_at((request.namespace, request.release), time.time() + known.pause.left)
        self._forget_some()
        return known.outcome

    async def close(self) -> None:
        """Stop all runs."""
        tasks = [each.work for each in self._renderings.values() if each.work is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _forget_some(self) -> None:
        while len(self._renderings) > KEPT:
            request, oldest = next(iter(self._renderings.items()))
            if oldest.work is not None:
                return
            del self._renderings[request]
            if all(each.source != request.source for each in self._renderings):
                self._sources.pop(request.source, None)

    async def _do(self, request: ChartRequest, known: _Rendering) -> None:
        try:
            outcome = await self._outcome(request)
        except Exception as error:  # a defect must not leave the instance waiting forever
            log.exception("cannot render the chart of %s/%s", request.namespace, request.release)
            outcome = ApplyProblem(FAILED, f"spec.helm: chart {request.source}: {type(error).__name__}: {error}")
        finally:
            known.work = None
        name = (request.namespace, request.release)
        known.outcome = outcome
        if isinstance(outcome, ApplyProblem):
            known.pause.fail(outcome)
        self._enqueue_at(name, time.time())

    async def _outcome(self, request: ChartRequest) -> ChartOutcome:
        source = self._sources.setdefault(request.source, _Source())
        async with source.runs:
            async with source.fetching:  # the first request fetches, the others use the cache
                if not source.pause.over and source.pause.failure is not None:
                    return source.pause.failure
                try:
                    async with self._runs:
                        path = await self._cache.path(request.source)
                except HelmError as error:
                    source.pause.fail(failure := unavailable(request.source, error))
                    return failure
            try:
                async with self._runs:
                    outcome = await rendered(self._helm, request, path)
            except HelmError as error:
                failure = failed(request.source, error)
                if error.slow:
                    source.pause.fail(failure)
                return failure
        source.pause = _Pause()
        return outcome


async def rendered(helm: HelmRunner, request: ChartRequest, path: Path) -> ChartOutcome:
    """The objects of the chart at the path, or why they cannot be used. Raises HelmError.

    The chart is rendered twice: an object that differs each time would be applied repeatedly.
    """
    text = await helm.template(request, path)
    if text != await helm.template(request, path):
        return ApplyProblem(
            FAILED,
            f"spec.helm: chart {request.source} renders different objects each time (with functions such as "
            "randAlphaNum, genCA or now), which would restart the application: set these values in "
            "spec.helm.values",
        )
    return await asyncio.to_thread(parse_chart, request.source, text)


async def rendered_at_once(helm: HelmRunner, cache: ChartCache, request: ChartRequest) -> ChartOutcome:
    """The result of the request, for callers that can wait: the chart is fetched if it is not cached."""
    try:
        path = await cache.path(request.source)
    except HelmError as error:
        return unavailable(request.source, error)
    try:
        return await rendered(helm, request, path)
    except HelmError as error:
        return failed(request.source, error)


def unavailable(source: ChartSource, error: HelmError) -> ApplyProblem:
    """The result for a chart that cannot be fetched."""
    return ApplyProblem(UNAVAILABLE, f"spec.helm: cannot fetch chart {source}: {error}")


def failed(source: ChartSource, error: HelmError) -> ApplyProblem:
    """The result for a chart that cannot be rendered."""
    return ApplyProblem(FAILED, f"spec.helm: chart {source}: {error}")
