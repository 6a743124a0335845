"""ApplicationInstance: one running (or lingering) instance of a template."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator
from pydantic.config import JsonDict

from wayside.api.base import (
    ATOMIC_LIST,
    Conditions,
    Count,
    Identifier,
    Kind,
    Model,
    TemplateName,
    Time,
)
from wayside.api.constraints import immutable, validation
from wayside.api.freedata import NestedValue

_IMMUTABLE = "is immutable: delete this instance and create another"


class ApplicationInstanceSpec(Model):
    """The template, and the values that result from merging the demands."""

    template_name: TemplateName = Field(json_schema_extra=immutable(_IMMUTABLE))
    """The name of the ApplicationTemplate, in the same namespace. Immutable."""
    key: str | None = Field(default=None, max_length=1024)
    """The value of the template's key; a list or map is written as JSON. Absent if the template has no key.
    Immutable."""
    # Server-side apply sets a map to null when its field manager removes the last entry that it owned.
    parameters: dict[Identifier, NestedValue] = Field(
        default_factory=dict, max_length=64, json_schema_extra={"nullable": True}
    )
    """The merged values of the template's parameters."""
    suspended: bool = False
    """If true, all workloads are scaled to zero, even if Deploy tasks are live. status.suspendedReplicas keeps their
    previous replica counts."""

    @field_validator("parameters", mode="before")
    @classmethod
    def _null_is_empty(cls, value: object) -> object:
        return {} if value is None else value


class ObjectReference(Model):
    """A reference to an object of the instance."""

    api_version: str = Field(max_length=255)
    """The object's apiVersion."""
    kind: str = Field(max_length=63)
    """The object's kind."""
    name: str = Field(max_length=253)
    """The object's name."""
    uid: str | None = Field(default=None, max_length=63)
    """The object's uid. Absent until the object has been applied for the first time."""


class SuspendedReplicas(Model):
    """A workload that is scaled to zero, and the replica count to restore."""

    api_version: str = Field(max_length=255)
    """The workload's apiVersion."""
    kind: str = Field(max_length=63)
    """The workload's kind."""
    name: str = Field(max_length=253)
    """The workload's name."""
    replicas: int = Field(ge=0)
    """The replica count to restore when the suspension ends."""


class Demands(Model):
    """The live tasks that the instance serves."""

    count: Count = 0
    """The number of live tasks."""
    names: list[Annotated[str, Field(max_length=253)]] = Field(
        default_factory=list, max_length=20, json_schema_extra=ATOMIC_LIST
    )
    """The names of the tasks, oldest first; at most 20."""


class InstancePhase(StrEnum):
    """A one-word summary of an instance's state."""

    PENDING = "Pending"
    APPLIED = "Applied"
    READY = "Ready"
    SUSPENDED = "Suspended"
    LINGERING = "Lingering"
    FAILED = "Failed"


class ApplicationInstanceStatus(Model):
    """The observed state of the instance."""

    phase: InstancePhase | None = None
    """A one-word summary of the state."""
    message: str | None = Field(default=None, max_length=512)
    """Why the instance is waiting or is being kept. Absent in normal operation."""
    observed_generation: Count = 0
    """The metadata.generation that the status was computed from."""
    spec_hash: str | None = Field(default=None, max_length=64)
    """The digest of the manifests at the last complete apply."""
    release_time: Time | None = None
    """The end of the linger time. The instance is then removed, unless a new demand arrives first."""
    objects: list[ObjectReference] = Field(default_factory=list, max_length=128, json_schema_extra=ATOMIC_LIST)
    """The objects of the instance. Each object is listed before it is applied. Only the objects of a new instance are
    listed later; until then, they are identified by label and controller reference."""
    suspended_replicas: list[SuspendedReplicas] = Field(
        default_factory=list, max_length=64, json_schema_extra=ATOMIC_LIST
    )
    """The replica counts to restore when the suspension ends. Written before any workload is scaled to zero, removed
    once all are restored."""
    demands: Demands = Demands()
    """The live tasks that the instance serves."""
    conditions: Conditions = Field(default_factory=list)
    """Applied: all objects match the template. Ready: the objects are applied and the workloads are ready. Stalled: the
    objects were refused, or did not become ready in time. Capped: a merged Sum is limited to its parameter's maximum.
    Suspended: the workloads are scaled to zero. Paused: the annotation wayside.dev/pause stops changes to the instance.
    Held: the annotation wayside.dev/hold keeps the instance even without demand. TimedOut: the instance was not ready
    for the template's readyTimeout. StandsIn: the instance is a fallback and serves the tasks of instances that timed
    out."""


class ApplicationInstance(Kind):
    """One running (or lingering) instance of a template. It owns all objects of the application."""

    plural: ClassVar[str] = "applicationinstances"
    short_name: ClassVar[str] = "appinst"
    printer_columns: ClassVar[list[dict[str, Any]]] = [
        {"name": "Template", "type": "string", "jsonPath": ".spec.templateName"},
        {"name": "Key", "type": "string", "jsonPath": ".spec.key"},
        {"name": "Demands", "type": "integer", "jsonPath": ".status.demands.count"},
        {"name": "Ready", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Ready")].status'},
        {"name": "Phase", "type": "string", "jsonPath": ".status.phase"},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": ".status.message"},
    ]
    object_validations: ClassVar[list[JsonDict]] = [
        validation(
            "has(self.spec.key) == has(oldSelf.spec.key) && (!has(self.spec.key) || self.spec.key == oldSelf.spec.key)",
            _IMMUTABLE,
            ".spec.key",
            "Forbidden",
        ),
    ]

    kind: str = "ApplicationInstance"
    spec: ApplicationInstanceSpec
    """The desired state: the template and its merged values."""
    status: ApplicationInstanceStatus | None = None
    """The observed state: objects, demands and conditions."""
