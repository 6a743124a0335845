"""ApplicationInstance: one running (or lingering) instance of a template."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field, field_validator

from wayside.api.base import Condition, Identifier, JsonValue, Kind, Model, TemplateName, Time, conditions_field


class ApplicationInstanceSpec(Model):
    """What runs: a template with the values that the demands agree on."""

    template: TemplateName = Field(description="The ApplicationTemplate, in the instance's namespace. Immutable.")
    key: str | None = Field(
        default=None,
        max_length=1024,
        description="The value of the template's key, lists and maps as JSON; absent where it has none. Immutable.",
    )
    parameters: dict[Identifier, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="The merged values of the template's parameters.",
        # Server-side apply makes a map null that loses the last entry which its manager had put there.
        json_schema_extra={"nullable": True},
    )
    suspended: bool = Field(
        default=False, description="true: its workloads are at zero, whoever demands it; status says what they were."
    )

    @field_validator("parameters", mode="before")
    @classmethod
    def _null_is_empty(cls, value: object) -> object:
        return {} if value is None else value


class ObjectReference(Model):
    """An object that belongs to the instance."""

    api_version: str = Field(max_length=255, description="The object's apiVersion.")
    kind: str = Field(max_length=63, description="The object's kind.")
    name: str = Field(max_length=253, description="The object's name.")
    uid: str | None = Field(
        default=None, max_length=63, description="The object's uid; absent until it was applied for the first time."
    )


class SuspendedReplicas(Model):
    """A workload that is at zero, and how many replicas it goes back to."""

    api_version: str = Field(max_length=255, description="The workload's apiVersion.")
    kind: str = Field(max_length=63, description="The workload's kind.")
    name: str = Field(max_length=253, description="The workload's name.")
    replicas: int = Field(ge=0, description="How many it had, or was to have.")


class Demands(Model):
    """The live tasks that the instance serves."""

    count: int = Field(default=0, description="How many.")
    names: list[Annotated[str, Field(max_length=253)]] = Field(
        default_factory=list,
        max_length=20,
        description="The oldest 20.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )


class InstancePhase(StrEnum):
    """An instance's state in one word."""

    PENDING = "Pending"
    APPLIED = "Applied"
    READY = "Ready"
    SUSPENDED = "Suspended"
    LINGERING = "Lingering"
    FAILED = "Failed"


class ApplicationInstanceStatus(Model):
    """What the instance consists of and how it is."""

    phase: InstancePhase | None = Field(default=None, description="The state in one word.")
    message: str | None = Field(
        default=None, max_length=512, description="What it waits for, or what keeps it; absent when all is as usual."
    )
    observed_generation: int = Field(default=0, description="The generation that the status speaks of.")
    spec_hash: str | None = Field(
        default=None, max_length=64, description="Digest of the manifests that were last applied in full."
    )
    release_time: Time | None = Field(
        default=None, description="When the instance is removed, if no new demand comes: the end of its linger."
    )
    objects: list[ObjectReference] = Field(
        default_factory=list,
        max_length=128,
        description="The objects that belong to it. What joins them later is written before it is applied; those of "
        "a new instance are told by their label and their controller reference until this is written.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    suspended_replicas: list[SuspendedReplicas] = Field(
        default_factory=list,
        max_length=64,
        description="What the workloads go back to; written before any is stopped, and removed once they are back.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    demands: Demands = Field(default=Demands(), description="The live tasks that it serves.")
    conditions: list[Condition] = conditions_field(
        "Applied: all objects are as the template states. Ready: they are, and the workloads are ready. "
        "Stalled: its objects are refused, or were not ready in time. Capped: a merged Sum is held "
        "at its parameter's bound. Suspended: its workloads are at zero. Paused, Held: a person wants it left as it is "
        "(annotation wayside.dev/pause), or kept without demand (wayside.dev/hold). TimedOut: it was not ready for its "
        "template's readyTimeout. StandsIn: it serves tasks of instances that are."
    )


class ApplicationInstance(Kind):
    """One running (or lingering) instance of a template; the owner of all its objects."""

    plural: ClassVar[str] = "applicationinstances"
    short_name: ClassVar[str] = "appinst"
    printer_columns: ClassVar[list[dict[str, str]]] = [
        {"name": "Template", "type": "string", "jsonPath": ".spec.template"},
        {"name": "Key", "type": "string", "jsonPath": ".spec.key"},
        {"name": "Demands", "type": "integer", "jsonPath": ".status.demands.count"},
        {"name": "Ready", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Ready")].status'},
        {"name": "Phase", "type": "string", "jsonPath": ".status.phase"},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": ".status.message"},
    ]
    object_validations: ClassVar[list[dict[str, str]]] = [
        {
            "rule": "self.spec.template == oldSelf.spec.template"
            " && has(self.spec.key) == has(oldSelf.spec.key)"
            " && (!has(self.spec.key) || self.spec.key == oldSelf.spec.key)",
            "message": "spec.template and spec.key are immutable: delete this instance and create another",
        },
    ]

    kind: str = "ApplicationInstance"
    spec: ApplicationInstanceSpec = Field(description="What runs.")
    status: ApplicationInstanceStatus | None = Field(default=None, description="What it consists of and how it is.")
