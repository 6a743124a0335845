"""What would run, from files alone: the same pure functions as in the cluster."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from application_manager.core import drafting
from application_manager.core.demand import Decision, demand
from application_manager.core.operations import Standing
from application_manager.core.policy import Policy
from application_manager.core.rendering import Renderer, RenderError
from wayside.api import ApplicationTask, ApplicationTemplate, Kind
from wayside.api.documents import load_documents
from wayside.manifests import to_yaml


@dataclass(frozen=True, slots=True)
class Rendered:
    """What would run.

    Attributes:
        objects: the instances, each followed by its manifests.
        refusals: what cannot be, one line each.
        notes: what else is worth knowing: tasks that wait, sums that are held at a bound.
    """

    objects: list[dict[str, Any]] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The objects as YAML documents."""
        return to_yaml(self.objects)


def render_files(paths: Iterable[Path], policy: Policy) -> Rendered:
    """What the templates and tasks in the files make run; other kinds are passed over.

    Raises DocumentError for files that cannot be read as our kinds.
    """
    return render_objects([document.object for document in load_documents(paths)], policy, time.time())


def render_objects(objects: Sequence[Kind], policy: Policy, now: float) -> Rendered:
    """What the templates and tasks make run, namespace by namespace; `now` in seconds since 1970."""
    result = Rendered()
    for namespace in sorted({each.namespace for each in objects}):
        here = [each for each in objects if each.namespace == namespace]
        templates = {each.name: each for each in here if isinstance(each, ApplicationTemplate)}
        tasks = [each for each in here if isinstance(each, ApplicationTask)]
        outcome = demand(templates.values(), tasks, [], {}, now)
        for name, verdict in sorted(outcome.verdicts.items()):
            line = f"ApplicationTask {namespace}/{name}: {verdict.reason}: {verdict.message}"
            if verdict.standing is Standing.REFUSED:
                result.refusals.append(line)
            elif verdict.standing is Standing.WAITING:
                result.notes.append(line)
        for decision in outcome.instances.values():
            _render(decision, templates[decision.template], policy, result)
    return result


def _render(decision: Decision, template: ApplicationTemplate, policy: Policy, result: Rendered) -> None:
    instance = drafting.draft((template.namespace, decision.name), decision, None)
    result.objects.append(drafting.created(instance, template))
    result.notes.extend(f"ApplicationInstance {template.namespace}/{decision.name}: {each}" for each in decision.capped)
    try:
        result.objects.extend(Renderer(template, policy).render(instance).manifests)
    except RenderError as error:
        what = f"ApplicationTemplate {template.namespace}/{template.name}"
        result.refusals.extend(f"{what}: {problem}" for problem in error.problems)
