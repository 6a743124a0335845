"""The applications for the tasks in a folder, step by step, computed by the manager's core."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.demand import demand
from application_manager.core.demand.lingering import LINGER_ANNOTATION
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, Rendering
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate
from wayside.api.applicationinstance import ApplicationInstanceSpec, ApplicationInstanceStatus
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL, Metadata
from wayside.times import format_seconds


@dataclass(frozen=True, slots=True)
class Change:
    """Something that happens to an instance: it starts, is reconfigured, lingers, stays after all, or is removed."""

    what: str
    instance: str
    detail: str


@dataclass(slots=True)
class Foresight:
    """The instances that would exist, brought up to date by `look`."""

    templates: list[ApplicationTemplate]
    instances: dict[str, ApplicationInstance] = field(default_factory=dict)
    ever: dict[str, Rendering] = field(default_factory=dict)
    """The latest manifests of every instance that there was."""

    def look(self, tasks: Mapping[str, ApplicationTask], now: float) -> Iterator[Change]:
        """The changes of applications due to the tasks; `now` is in seconds since the epoch."""
        outcome = demand(self.templates, tasks.values(), self.instances.values(), {}, now)
        for name, decision in outcome.instances.items():
            yield from self._decided(name, decision, now)

    def _decided(self, name: str, decision: Decision, now: float) -> Iterator[Change]:
        before = self.instances.get(name)
        if decision.release_time is not None and decision.release_time <= now:
            del self.instances[name]
            yield Change("is removed", name, "")
            return
        template = next(each for each in self.templates if each.name == decision.template)
        after = _instance(decision, before, template)
        self.instances[name] = after
        self.ever[name] = Renderer(template, Policy()).render(after)
        lingering = decision.release_time is not None
        lingered = before is not None and before.status is not None and before.status.release_time is not None
        if before is None:
            yield Change("starts", name, f"{_text(after.spec.parameters)}  ({self._objects(name)})")
        elif before.spec.parameters != after.spec.parameters:
            yield Change("is reconfigured", name, _text(after.spec.parameters))
        elif lingering and not lingered:
            yield Change("lingers", name, f"no demand is left; removed in {template.spec.lifecycle.linger}")
        elif lingered and not lingering:
            yield Change("stays", name, "demanded again during its linger; it did not stop")

    def _objects(self, name: str) -> str:
        return ", ".join(sorted(each["kind"] for each in self.ever[name].manifests))


class TaskFolder:
    """The ApplicationTasks that a detector leaves in a folder, read again when they change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[Path, tuple[int, ApplicationTask]] = {}

    def tasks(self) -> dict[str, ApplicationTask]:
        """All tasks by name, ended ones too."""
        for file in self._folder.glob("*.yaml"):
            changed = file.stat().st_mtime_ns
            if self._read.get(file, (0, None))[0] != changed:
                raw = yaml.safe_load(file.read_text(encoding="utf-8"))
                self._read[file] = (changed, ApplicationTask.model_validate(raw))
        return {task.name: task for _, task in self._read.values()}


def _instance(
    decision: Decision, before: ApplicationInstance | None, template: ApplicationTemplate
) -> ApplicationInstance:
    parameters: dict[str, Any] = (
        decision.parameters if decision.parameters is not None else before.spec.parameters if before else {}
    )
    return ApplicationInstance(
        metadata=Metadata(
            name=decision.name,
            labels={MANAGED_BY_LABEL: MANAGED_BY},
            annotations={LINGER_ANNOTATION: str(template.spec.lifecycle.linger)},
        ),
        spec=ApplicationInstanceSpec(template_name=decision.template, key=decision.key, parameters=parameters),
        status=ApplicationInstanceStatus(
            release_time=None if decision.release_time is None else format_seconds(decision.release_time)
        ),
    )


def _text(parameters: Mapping[str, Any]) -> str:
    return "  ".join(
        f"{name}={'+'.join(value) if isinstance(value, list) else value}" for name, value in parameters.items()
    )
