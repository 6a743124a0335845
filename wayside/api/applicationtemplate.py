"""ApplicationTemplate: how an application is deployed, and how the demands of several tasks become one."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator, model_validator
from pydantic.config import JsonDict

from wayside.api.base import (
    ATOMIC_LIST,
    Conditions,
    Count,
    Duration,
    Expression,
    Identifier,
    Kind,
    Model,
    PositiveDuration,
    TemplateName,
    Time,
)
from wayside.api.constraints import constraint, exactly_one, validation
from wayside.api.freedata import NamedData, Value
from wayside.api.parameter import Parameter


class LossPolicy(StrEnum):
    """The treatment of demands after their holder was lost."""

    RELEASE = "Release"
    HOLD = "Hold"


class OnDetectorLoss(Model):
    """The policy for demands whose holder's Lease has expired."""

    policy: LossPolicy = LossPolicy.RELEASE
    """Release: the demands stop counting. Hold: the demands count until they end."""
    after: Duration = Duration("30s")
    """With policy Release: how long the demands still count after the Lease has expired."""


class FallbackTemplate(Model):
    """The template that replaces an application which does not become ready."""

    template_name: TemplateName
    """The name of another ApplicationTemplate, in the same namespace."""


class Lifecycle(Model):
    """The lifetime of instances."""

    constraints = (
        constraint(
            "!has(self.fallback) || has(self.readyTimeout)",
            "fallback needs readyTimeout: set it, e.g. readyTimeout: 60s",
            ".readyTimeout",
            "Required",
            holds=lambda lifecycle: lifecycle.fallback is None or lifecycle.ready_timeout is not None,
        ),
    )

    linger: Duration = Duration("30s")
    """How long an instance keeps running after its last demand has ended."""
    min_uptime: Duration = Duration("0s")
    """The minimum lifetime of an instance, from its creation. During this time, the instance is neither released nor
    preempted."""
    ready_timeout: PositiveDuration | None = None
    """How long an instance may stay not ready. After that, its condition TimedOut is True until the instance has been
    ready for the same time. Default: no limit."""
    fallback: FallbackTemplate | None = None
    """The template that serves the tasks of an instance that exceeded its readyTimeout, until that instance is ready
    again. It receives only those parameters of the tasks that it defines. Needs readyTimeout."""
    on_detector_loss: OnDetectorLoss = OnDetectorLoss()
    """The policy for demands whose holder's Lease has expired."""


class Baseline(Model):
    """An instance that always runs, with or without tasks."""

    parameters: NamedData = Field(default_factory=dict)
    """The parameter values of the baseline. With merge Same, tasks must have the same values. With any other merge,
    they count as the values of a task of the lowest priority."""


Manifest = Annotated[
    dict[str, Any], Field(max_length=64, json_schema_extra={"x-kubernetes-preserve-unknown-fields": True})
]


FileName = Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[-._a-zA-Z0-9]+$")]
"""A file's name, as ConfigMaps allow it."""


OCI = "oci://"

_FORMS = (
    "write oci://… with a version, the name of a chart with its repository and version, or the absolute path of a "
    "folder or archive in the manager's image"
)
_VERSION = r"^v?[0-9]+(\.[0-9]+){0,2}(-[0-9A-Za-z.-]+)?(\+[0-9A-Za-z.-]+)?$"


class Helm(Model):
    """A chart and its values."""

    constraints = (
        constraint(
            "self.chart.startsWith('/') ? !has(self.version) && !has(self.repository) : has(self.version)",
            "a chart from a registry or repository needs version; for a path, remove version and repository",
            ".version",
        ),
        constraint(
            "self.chart.startsWith('/') || self.chart.startsWith('oci://') != has(self.repository)",
            "a chart name needs repository; for oci://…, remove repository",
            ".repository",
        ),
    )

    # Must not begin with `-`: it becomes an argument of a program.
    chart: str = Field(
        min_length=1, max_length=512, pattern=r"^(oci://[a-zA-Z0-9][^ ?#@]*|/[^ ]+|[a-zA-Z0-9][a-zA-Z0-9._-]*)$"
    )
    """The chart: an OCI reference (oci://…), the name of a chart in `repository`, or an absolute path in the manager's
    image."""
    version: str | None = Field(default=None, max_length=128, pattern=_VERSION)
    """The exact version of the chart. Ranges are not allowed: the same template must always render the same objects.
    Required unless chart is a path."""
    repository: str | None = Field(default=None, max_length=512, pattern=r"^https?://[^ ]+$")
    """The URL of the chart repository. Only for a chart given by name."""
    values: dict[str, Any] = Field(
        default_factory=dict, max_length=256, json_schema_extra={"x-kubernetes-preserve-unknown-fields": True}
    )
    """The values of the chart. They can contain ${…} with parameters and instance (name, key, namespace, configMap)."""

    @model_validator(mode="after")
    def _one_place(self) -> Helm:
        if self.chart.startswith("/"):
            if self.version is not None or self.repository is not None:
                raise ValueError(f"chart {self.chart} is a path: remove version and repository")
        elif self.version is None:
            raise ValueError(f"chart {self.chart} needs an exact version: {_FORMS}")
        elif self.chart.startswith(OCI) == (self.repository is not None):
            problem = (
                "needs a repository" if self.repository is None else "is an OCI reference, which has no repository"
            )
            raise ValueError(f"chart {self.chart} {problem}: {_FORMS}")
        return self


class ApplicationTemplateSpec(Model):
    """Parameters, identity and manifests of an application."""

    constraints = (
        exactly_one("manifests", "helm"),
        constraint(
            "!has(self.baseline) || !has(self.key)",
            "baseline is valid only without key: remove baseline or key; with key, use a rule with `when: true`",
            ".baseline",
            "Forbidden",
            holds=lambda template: template.baseline is None or template.key is None,
        ),
    )

    description: str = Field(default="", max_length=1024)
    """A description of the application, for people."""
    parameters: dict[Identifier, Parameter] = Field(default_factory=dict, max_length=64)
    """The inputs of the template, by name: type, bounds, and how the values of several tasks merge."""
    key: Expression | None = None
    """The identity of an instance, e.g. ${parameters.region}. Tasks with the same key share one instance. Without a
    key, the template has one instance. Immutable."""
    baseline: Baseline | None = None
    """One instance that always runs, with or without tasks. Only for a template without a key; with a key, use a rule
    with `when: true` instead."""
    max_instances: int | None = Field(default=None, ge=1, le=100_000)
    """The maximum number of instances. At the limit, a demand waits or preempts an instance of lower priority. Default:
    no limit."""
    lifecycle: Lifecycle = Lifecycle()
    """The lifetime of instances."""
    configuration: dict[FileName, Value] = Field(default_factory=dict, max_length=64)
    """Files, by name, that can change while the application runs. They can contain ${…}, as in manifests. The manager
    writes them to the ConfigMap ${instance.configMap} and changes them without a rollout. A string is written
    unchanged; a map or list is written in the format of the file extension, .yaml or .json."""
    manifests: list[Manifest] = Field(default_factory=list, min_length=1, max_length=64, json_schema_extra=ATOMIC_LIST)
    """The objects of an instance. Values can contain ${…} with parameters and instance (name, key, namespace, and
    configMap if there is a configuration). apiVersion and kind must be literal. The namespace is that of the template.
    With a key, every name must contain ${instance.name}."""
    helm: Helm | None = None
    """A Helm chart instead of manifests. The same kinds of object are allowed, and they are applied in the same way.
    The release has the name of the instance."""

    @field_validator("manifests")
    @classmethod
    def _literal_kinds(cls, manifests: list[dict[str, Any]]) -> list[dict[str, Any]]:
        for index, manifest in enumerate(manifests):
            for field in ("apiVersion", "kind"):
                value = manifest.get(field)
                if not isinstance(value, str) or not value:
                    raise ValueError(f"manifests[{index}].{field}: is missing: give it as a string")
                if "${" in value:
                    raise ValueError(f"manifests[{index}].{field}: {value!r} must be literal, without ${{…}}")
        return manifests


class TemplateManager(Model):
    """An application manager, by its Lease."""

    lease: str = Field(max_length=320)
    """Namespace and name of its Lease."""
    since: Time
    """The creation time of the Lease. Of two managers, the one with the older Lease is active."""


class ApplicationTemplateStatus(Model):
    """The observed state of the template."""

    observed_generation: Count = 0
    """The metadata.generation that the status was computed from."""
    instances: Count = 0
    """The number of instances."""
    manager: TemplateManager | None = None
    """The application manager that is active in the namespace."""
    conditions: Conditions = Field(default_factory=list)
    """Accepted, Ready: the template can be rendered. Stalled: the template is invalid and must be corrected."""


class ApplicationTemplate(Kind):
    """The definition of an application: how to deploy it, and how to merge the demands for it."""

    plural: ClassVar[str] = "applicationtemplates"
    short_name: ClassVar[str] = "apptpl"
    name_limit: ClassVar[int] = 40
    printer_columns: ClassVar[list[dict[str, Any]]] = [
        {"name": "Key", "type": "string", "jsonPath": ".spec.key"},
        {"name": "Instances", "type": "integer", "jsonPath": ".status.instances"},
        {"name": "Max", "type": "integer", "jsonPath": ".spec.maxInstances"},
        {"name": "Ready", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Ready")].status'},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": '.status.conditions[?(@.status=="False")].message'},
    ]
    object_validations: ClassVar[list[JsonDict]] = [
        validation(
            "has(self.spec.key) == has(oldSelf.spec.key) && (!has(self.spec.key) || self.spec.key == oldSelf.spec.key)",
            "is immutable, and cannot be added or removed: create another template",
            ".spec.key",
            "Forbidden",
        ),
        validation(
            "!has(self.spec.lifecycle) || !has(self.spec.lifecycle.fallback)"
            " || self.spec.lifecycle.fallback.templateName != self.metadata.name",
            "must be another template than this one",
            ".spec.lifecycle.fallback.templateName",
        ),
    ]

    kind: str = "ApplicationTemplate"
    spec: ApplicationTemplateSpec
    """The parameters, identity, lifetime and objects of an application."""
    status: ApplicationTemplateStatus | None = None
    """The observed state of the template."""
