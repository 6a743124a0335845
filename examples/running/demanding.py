"""The applications that would run for a scenario's tasks at a moment, by the application manager's pure functions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from application_manager.core.demand.demand import demand
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer
from examples.running.scenario import START_NS, Moment
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate
from wayside.api.applicationinstance import ApplicationInstanceSpec
from wayside.api.base import Metadata
from wayside.api.documents import load_documents


@dataclass(frozen=True, slots=True)
class RunningTask:
    """The content of an instance."""

    kinds: tuple[str, ...]
    """Of its objects, sorted."""
    configuration: Mapping[str, Any] = field(default_factory=dict)
    """The merged files of its ConfigMap."""
    suspended: bool = False


def running_at(folder: Path, history: Iterable[tuple[float, ApplicationTask]], at_s: float) -> dict[str, RunningTask]:
    """What would run at second `at_s`, by `<template>/<key>`; what only lingers is not there.

    Args:
        folder: the use case's, with `templates.yaml`.
        history: each version of each task, with the second from which on it was so.
        at_s: seconds into the scenario.
    """
    templates = {
        each.object.name: each.object
        for each in load_documents([folder / "templates.yaml"])
        if isinstance(each.object, ApplicationTemplate)
    }
    latest = {task.name: task for since_s, task in history if since_s <= at_s}
    live = [task for task in latest.values() if task.spec.end_time is None]
    outcome = demand(templates.values(), live, [], {}, START_NS / 1e9 + at_s)
    found = {}
    for name, decision in outcome.instances.items():
        spec = ApplicationInstanceSpec(
            template_name=decision.template, key=decision.key, parameters=decision.parameters or {},
            suspended=bool(decision.suspended),
        )  # fmt: skip
        instance = ApplicationInstance(metadata=Metadata(name=name), spec=spec)
        manifests = Renderer(templates[decision.template], Policy()).render(instance).manifests
        found[f"{decision.template}/{decision.key or ''}"] = consists_of(manifests, suspended=bool(decision.suspended))
    return found


def consists_of(manifests: Sequence[Mapping[str, Any]], *, suspended: bool = False) -> RunningTask:
    """The content of an instance with these objects."""
    configuration: dict[str, Any] = {}
    for manifest in manifests:
        if manifest["kind"] == "ConfigMap":
            for text in manifest.get("data", {}).values():
                content = yaml.safe_load(text)
                configuration |= content if isinstance(content, dict) else {}
    return RunningTask(tuple(sorted(manifest["kind"] for manifest in manifests)), configuration, suspended)


def unlike(moment: Moment, found: Mapping[str, RunningTask]) -> Iterator[str]:
    """The differences between running and expected applications at the moment, a line each."""
    for name in sorted({*moment.runs, *found}):
        if name not in found:
            yield f"at {moment.at_s:g} s {name} does not run"
        elif name not in moment.runs:
            yield f"at {moment.at_s:g} s {name} runs; it must not"
        else:
            if found[name].suspended != (name in moment.suspended):
                yield f"at {moment.at_s:g} s {name} is {'suspended' if found[name].suspended else 'not suspended'}"
            there = {key: found[name].configuration.get(key) for key in moment.runs[name]}
            if there != dict(moment.runs[name]):
                yield f"at {moment.at_s:g} s {name} is configured with {there}; expected: {dict(moment.runs[name])}"
