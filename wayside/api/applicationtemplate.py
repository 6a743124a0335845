"""ApplicationTemplate: how an application is deployed, and how the demands of several tasks become one."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator, model_validator

from wayside.api.base import (
    Condition,
    Duration,
    Expression,
    Identifier,
    JsonValue,
    Kind,
    Model,
    PositiveDuration,
    TemplateName,
    Time,
    conditions_field,
    validations,
)
from wayside.api.chart import Helm
from wayside.api.parameter import Parameter


class LossPolicy(StrEnum):
    """What becomes of demands whose holder is gone."""

    RELEASE = "Release"
    HOLD = "Hold"


class OnDetectorLoss(Model):
    """What becomes of demands whose holder's Lease lapsed."""

    policy: LossPolicy = Field(
        default=LossPolicy.RELEASE, description="Release: they no longer count. Hold: they count until they end."
    )
    after: Duration = Field(
        default=Duration("30s"), description="With Release: how long after the Lease's own duration they still count."
    )


class FallbackTemplate(Model):
    """What serves where an application does not become ready."""

    template: TemplateName = Field(description="An ApplicationTemplate of the same namespace, and another one.")


FALLBACK_WITHOUT_TIMEOUT = (
    "fallback needs readyTimeout, which says when an instance counts as not becoming ready: give it, e.g. 60s"
)


class Lifecycle(Model):
    """How long instances live."""

    model_config = validations(("!has(self.fallback) || has(self.readyTimeout)", FALLBACK_WITHOUT_TIMEOUT))

    linger: Duration = Field(
        default=Duration("30s"), description="How long an instance stays after its last demand has ended."
    )
    minimum_uptime: Duration = Field(
        default=Duration("0s"),
        description="How long an instance stays at least, from its creation: neither released nor preempted before.",
    )
    ready_timeout: PositiveDuration | None = Field(
        default=None,
        description="How long an instance may be not ready in one go; then its condition TimedOut is True, until it "
        "was ready for as long. Absent: any time.",
    )
    fallback: FallbackTemplate | None = Field(
        default=None,
        description="What serves the tasks of an instance that is beyond its readyTimeout, until it is ready again. It "
        "gets those of their parameters that it has.",
    )
    on_detector_loss: OnDetectorLoss = Field(
        default=OnDetectorLoss(), description="What becomes of demands whose holder's Lease lapsed."
    )

    @model_validator(mode="after")
    def _fallback_has_its_time(self) -> Lifecycle:
        if self.fallback is not None and self.ready_timeout is None:
            raise ValueError(FALLBACK_WITHOUT_TIMEOUT)
        return self


BASELINE_WITH_KEY = (
    "baseline is for a template without a key, which has one instance: remove one of the two; with a key, a rule whose "
    "`when` is true says which instances run always"
)


class Baseline(Model):
    """An instance that runs always, whether tasks demand it or not."""

    parameters: dict[Identifier, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="Its values. With merge Same, tasks must agree with them; else they count as those of a task of "
        "the lowest priority.",
    )


Manifest = Annotated[dict[str, Any], Field(json_schema_extra={"x-kubernetes-preserve-unknown-fields": True})]


FileName = Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[-._a-zA-Z0-9]+$")]
"""A file's name, as ConfigMaps allow it."""

_ONE_OF = "give exactly one of manifests and helm"


class ApplicationTemplateSpec(Model):
    """Parameters, identity and manifests of an application."""

    model_config = validations(
        ("has(self.manifests) != has(self.helm)", _ONE_OF),
        ("!has(self.baseline) || !has(self.key)", BASELINE_WITH_KEY),
    )

    description: str = Field(default="", max_length=1024, description="What the application does, for people.")
    parameters: dict[Identifier, Parameter] = Field(
        default_factory=dict, max_length=64, description="What tasks can or must say, and how their values merge."
    )
    key: Expression | None = Field(
        default=None,
        description="Tasks with the same key share one instance, e.g. ${parameters.region}. "
        "Without a key the template has one instance. Immutable.",
    )
    baseline: Baseline | None = Field(
        default=None,
        description="One instance that runs always, also without tasks. Not with a key: a rule with when: true then "
        "says which instances run.",
    )
    max_instances: int | None = Field(
        default=None,
        ge=1,
        le=100_000,
        description="How many instances there may be at once; further demands wait, or preempt what has a lower "
        "priority. Absent: any number.",
    )
    lifecycle: Lifecycle = Field(default=Lifecycle(), description="How long instances live.")
    configuration: dict[FileName, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="Files that the running application follows, by name, with ${…} as in manifests. They become a "
        "ConfigMap, ${instance.configMap}, which changes without a rollout. A text is written as it is; a map or a "
        "list as the extension says, .yaml or .json.",
    )
    manifests: list[Manifest] = Field(
        default_factory=list,
        min_length=1,
        max_length=64,
        description="The objects of an instance, with ${…} over parameters and instance (name, key, namespace, and "
        "configMap where there is a configuration). "
        "apiVersion and kind are literal, the namespace is the template's, and with a key every name contains "
        "${instance.name}.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    helm: Helm | None = Field(
        default=None,
        description="A Helm chart in place of manifests. Its objects are applied as manifests are, of the same kinds; "
        "the release's name is the instance's.",
    )

    @model_validator(mode="after")
    def _one_kind_of_objects(self) -> ApplicationTemplateSpec:
        if bool(self.manifests) == (self.helm is not None):
            raise ValueError(_ONE_OF)
        return self

    @model_validator(mode="after")
    def _one_baseline(self) -> ApplicationTemplateSpec:
        if self.baseline is not None and self.key is not None:
            raise ValueError(BASELINE_WITH_KEY)
        return self

    @field_validator("manifests")
    @classmethod
    def _literal_kinds(cls, manifests: list[dict[str, Any]]) -> list[dict[str, Any]]:
        for index, manifest in enumerate(manifests):
            for field in ("apiVersion", "kind"):
                value = manifest.get(field)
                if not isinstance(value, str) or not value:
                    raise ValueError(
                        f"manifests[{index}].{field}: is missing: every manifest needs apiVersion and kind"
                    )
                if "${" in value:
                    raise ValueError(f"manifests[{index}].{field}: {value!r} must be literal, without ${{…}}")
        return manifests


class TemplateManager(Model):
    """An application manager, by its Lease."""

    lease: str = Field(max_length=320, description="Namespace and name of its Lease.")
    since: Time = Field(description="When the Lease was created: of two managers, the one with the older Lease acts.")


class ApplicationTemplateStatus(Model):
    """What the application manager says of the template."""

    observed_generation: int = Field(default=0, description="The generation that the status speaks of.")
    instances: int = Field(default=0, description="How many instances there are.")
    manager: TemplateManager | None = Field(
        default=None, description="The application manager that looks after the namespace."
    )
    conditions: list[Condition] = conditions_field(
        "Accepted, Ready: whether the template can be rendered. Stalled: it has to be corrected."
    )


class ApplicationTemplate(Kind):
    """How an application is deployed, and how the demands on it merge."""

    plural: ClassVar[str] = "applicationtemplates"
    short_name: ClassVar[str] = "apptpl"
    name_limit: ClassVar[int] = 40
    printer_columns: ClassVar[list[dict[str, str]]] = [
        {"name": "Key", "type": "string", "jsonPath": ".spec.key"},
        {"name": "Instances", "type": "integer", "jsonPath": ".status.instances"},
        {"name": "Max", "type": "integer", "jsonPath": ".spec.maxInstances"},
        {"name": "Accepted", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Accepted")].status'},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": '.status.conditions[?(@.status=="False")].message'},
    ]
    object_validations: ClassVar[list[dict[str, str]]] = [
        {
            "rule": "has(self.spec.key) == has(oldSelf.spec.key)"
            " && (!has(self.spec.key) || self.spec.key == oldSelf.spec.key)",
            "message": "spec.key is immutable, also in being there: make a template of another name instead",
        },
        {
            "rule": "!has(self.spec.lifecycle) || !has(self.spec.lifecycle.fallback)"
            " || self.spec.lifecycle.fallback.template != self.metadata.name",
            "message": "spec.lifecycle.fallback.template is this template itself: name another",
        },
    ]

    kind: str = "ApplicationTemplate"
    spec: ApplicationTemplateSpec = Field(description="Parameters, identity and manifests.")
    status: ApplicationTemplateStatus | None = Field(
        default=None, description="What the application manager says of the template."
    )
