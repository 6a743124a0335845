"""The shape of an explanation: what `application-manager explain -o json` prints.

An interface: fields are only added.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from wayside.api.base import Model


class ExplainedContribution(Model):
    """What one task gives for one parameter, and what came of it.

    `effect` is `decides` (the merged value is this one), `part` (it is in it), `outbid` (another value counts), or
    `none` (the task does not count).
    """

    task: str
    value: Any
    effect: Literal["decides", "part", "outbid", "none"]
    why: str | None = None


class ExplainedParameter(Model):
    """One parameter of the template.

    `source` is `tasks`, `default`, `baseline`, `earlier` (no task gives it now; the instance keeps what it
    has), or `none`. `note` names the bound that holds a merged sum.
    """

    name: str
    merge: str
    value: Any = None
    source: str
    note: str | None = None
    contributions: list[ExplainedContribution] = Field(default_factory=list)


class ExplainedTask(Model):
    """One task, and why it counts or does not.

    `phase` and `conditions` are as written; `verdict`, `reason` and `message` are computed now. `not_looked_at`: the
    manager has not written of its present version.
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
    not_looked_at: bool


class ExplainedTemplate(Model):
    """The template; `problem` is the reason why it cannot be used."""

    name: str
    problem: str | None = None
    key: str | None = None


class ExplainedInstance(Model):
    """The instance; `exists` is false where it should be and is not yet.

    Its template is the fallback's where that serves the task meanwhile.
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
    """A pod of the instance; `problem` is what keeps it from running, where something does."""

    name: str
    phase: str
    node: str | None = None
    ready: bool
    problem: str | None = None


class Explanation(Model):
    """The chain: the task in question, if it was one, its template, the instance and all of its tasks, the
    merged parameters, the objects and the pods."""

    task: ExplainedTask | None = None
    template: ExplainedTemplate
    instance: ExplainedInstance | None = None
    tasks: list[ExplainedTask]
    parameters: list[ExplainedParameter]
    objects: list[ExplainedObject]
    pods: list[ExplainedPod]
