"""Renders one chart once, and explains a failure."""

from __future__ import annotations

import asyncio
from pathlib import Path

from application_manager.charts.chartcache import ChartCache
from application_manager.charts.helm import HelmError, HelmRunner
from application_manager.core.objects.charts import (
    FAILED,
    UNAVAILABLE,
    ChartFailure,
    ChartOutcome,
    ChartRequest,
    ChartSource,
    parse_chart,
)


async def rendered(helm: HelmRunner, request: ChartRequest, path: Path) -> ChartOutcome:
    """The objects of the chart at the path, or why they cannot be used.

    It is rendered twice: what differs each time would be applied again and again.

    Raises:
        HelmError: Helm cannot render it.
    """
    text = await helm.template(request, path)
    if text != await helm.template(request, path):
        return ChartFailure(
            FAILED,
            f"spec.helm: chart {request.source} renders different objects each time (with functions such as "
            "randAlphaNum, genCA or now), which would restart the application: set these values in "
            "spec.helm.values",
        )
    return await asyncio.to_thread(parse_chart, request.source, text)


async def rendered_at_once(helm: HelmRunner, cache: ChartCache, request: ChartRequest) -> ChartOutcome:
    """The same from the beginning, for who can wait: the chart is fetched where it is not here yet."""
    try:
        path = await cache.path(request.source)
    except HelmError as error:
        return unavailable(request.source, error)
    try:
        return await rendered(helm, request, path)
    except HelmError as error:
        return failed(request.source, error)


def unavailable(source: ChartSource, error: HelmError) -> ChartFailure:
    """The chart cannot be had."""
    return ChartFailure(UNAVAILABLE, f"spec.helm: cannot fetch chart {source}: {error}")


def failed(source: ChartSource, error: HelmError) -> ChartFailure:
    """The chart cannot be rendered."""
    return ChartFailure(FAILED, f"spec.helm: chart {source}: {error}")
