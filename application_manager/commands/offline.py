"""Computes the demand from files alone, with the same pure functions as in the cluster."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from application_manager.charts.chartcache import ChartCache, default_folder
from application_manager.charts.chartrenderer import rendered_at_once
from application_manager.charts.helm import HelmRunner
from application_manager.core.claims.operations import VerdictKind
from application_manager.core.demand import drafting
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.demand import demand
from application_manager.core.objects.charts import Charts, no_charts
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, RenderError
from wayside.api import ApplicationTask, ApplicationTemplate, Kind


@dataclass(frozen=True, slots=True)
class OfflineResult:
    """The result.

    Attributes:
        objects: the instances, each followed by its manifests.
        refusals: one line for each problem.
        notes: further remarks: tasks that wait, sums that are capped.
    """

    objects: list[dict[str, Any]] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def charts_at_once(helm: HelmRunner, cache: Path | None, folder: Path) -> Charts:
    """Renders charts while the caller waits.

    `cache` and `folder` are the values of the options; `cache` None: the default one.
    """
    kept = ChartCache(helm, cache or default_folder(), folder)
    return lambda request: asyncio.run(rendered_at_once(helm, kept, request))


def render_objects(
    objects: Sequence[Kind], policy: Policy, now: float, limit: int | None = None, charts: Charts = no_charts
) -> OfflineResult:
    """The result of the templates and tasks, namespace by namespace; objects of other kinds are ignored.

    `now` is in seconds since 1970; `limit`: the maximum number of instances in a namespace, None for no limit.
    """
    result = OfflineResult()
    for namespace in sorted({each.namespace for each in objects}):
        here = [each for each in objects if each.namespace == namespace]
        templates = {each.name: each for each in here if isinstance(each, ApplicationTemplate)}
        tasks = [each for each in here if isinstance(each, ApplicationTask)]
        outcome = demand(templates.values(), tasks, [], {}, now, limit)
        for name, verdict in sorted(outcome.verdicts.items()):
            line = f"ApplicationTask {namespace}/{name}: {verdict.reason}: {verdict.message}"
            if verdict.kind is VerdictKind.REFUSED:
                result.refusals.append(line)
            elif verdict.kind is VerdictKind.WAITING:
                result.notes.append(line)
        for decision in outcome.instances.values():
            _render(decision, templates[decision.template], policy, charts, result)
    return result


def _render(
    decision: Decision, template: ApplicationTemplate, policy: Policy, charts: Charts, result: OfflineResult
) -> None:
    instance = drafting.draft((template.namespace, decision.name), decision, None)
    result.objects.append(drafting.created(instance, template))
    result.notes.extend(f"ApplicationInstance {template.namespace}/{decision.name}: {each}" for each in decision.capped)
    try:
        result.objects.extend(Renderer(template, policy).render(instance, charts).manifests)
    except RenderError as error:
        what = f"ApplicationTemplate {template.namespace}/{template.name}"
        result.refusals.extend(f"{what}: {problem}" for problem in error.problems)
