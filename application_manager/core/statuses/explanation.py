"""The schema of explanations, as printed by `application-manager explain -o json`. Fields are only added."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from wayside.api.base import Model


class ExplainedContribution(Model):
    """The value of one task for one parameter, and its effect.

    `effect` is `decides` (it is the merged value), `part` (it is a part of the merged value), `outbid` (another value
    counts), or `none` (the task does not count).
    """

    task: str
    value: Any
    effect: Literal["decides", "part", "outbid", "none"]
    why: str | None = None


class ExplainedParameter(Model):
    """One parameter of the template.

    `source` is `tasks`, `default`, `baseline`, `earlier` (no task gives it now; the instance keeps its value), or
    `none`. `note` names the bound that caps a merged sum.
    """

    name: str
    merge: str
    value: Any = None
    source: str
    note: str | None = None
    contributions: list[ExplainedContribution] = Field(default_factory=list)


class ExplainedTask(Model):
    """One task, and why it counts or not.

    `phase` and `conditions` come from its status; `verdict`, `reason` and `message` are computed now. `unprocessed`:
    whether the manager has not processed its current generation.
    """

    name: str
    phase: str | None = None
    verdict: str
    reason: str
    message: str
    operation: str = "Deploy"
    priority: int
    created: str | None = None
    detector: str | None = None
    holder: str | None = None
    lease_age_seconds: float | None = None
    holder_is_lost: bool
    rule: str | None = None
    subject: str | None = None
    event: dict[str, Any] | None = None
    parameters: dict[str, Any]
    conditions: list[dict[str, Any]]
    unprocessed: bool


class ExplainedTemplate(Model):
    """The template; `problem` is the reason why it cannot be used."""

    name: str
    problem: str | None = None
    key: str | None = None


class ExplainedInstance(Model):
    """The instance; `exists` is false if it is demanded but does not exist yet.

    If the fallback serves the task, this is the fallback's instance, with its template.
    """

    name: str
    template: str | None = None
    exists: bool
    managed: bool
    key: str | None = None
    phase: str | None = None
    release_time: str | None = None
    conditions: list[dict[str, Any]]


class ExplainedObject(Model):
    """An object of the instance; `problem` is the reason why it is not ready."""

    api_version: str
    kind: str
    name: str
    ready: bool
    problem: str | None = None


class ExplainedPod(Model):
    """A pod of the instance; `problem` is the reason why it does not run, if it does not."""

    name: str
    phase: str
    node: str | None = None
    ready: bool
    problem: str | None = None


class Explanation(Model):
    """The chain: the task in question, if any, its template, the instance and its tasks, and their results."""

    task: ExplainedTask | None = None
    template: ExplainedTemplate
    instance: ExplainedInstance | None = None
    tasks: list[ExplainedTask]
    parameters: list[ExplainedParameter]
    objects: list[ExplainedObject]
    pods: list[ExplainedPod]
