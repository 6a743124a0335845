"""ApplicationTask: one demand for an application, and its cause."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field
from pydantic.config import JsonDict

from wayside.api.base import (
    ATOMIC_LIST,
    SUBDOMAIN,
    Conditions,
    Count,
    Identifier,
    Kind,
    Model,
    ObjectName,
    TemplateName,
    Time,
)
from wayside.api.classification import Classification
from wayside.api.constraints import immutable, validation
from wayside.api.freedata import NestedValue
from wayside.api.operation import MEANING, Operation

_IMMUTABLE = "is immutable; only parameters and endTime can change: end this task and create another"

HOLDER_LABEL = "wayside.dev/holder"
RULE_DIGEST_ANNOTATION = "wayside.dev/rule-digest"
"""Digest of the rule's semantics (see `EventRule.semantics`) under which the episode started."""
TRACEPARENT_ANNOTATION = "wayside.dev/traceparent"
"""The position of the task in a trace, in the format of W3C's header `traceparent`; absent if tracing is off."""

Holder = Annotated[str, Field(min_length=1, max_length=253 - len("wayside-"), pattern=f"^{SUBDOMAIN}$")]
"""The name of a holder, from which its Lease has its name."""


class Requester(Model):
    """The subjects on whose behalf the task was emitted, and the holder that emitted it."""

    detector_name: ObjectName | None = None
    """The name of the Detector. Absent in a task that a person created."""
    holder: Holder | None = None
    """The holder that emitted the task. The holder keeps the task alive by renewing the Lease wayside-<holder>. A task
    without a holder never expires."""
    subjects: list[Annotated[str, Field(max_length=256)]] = Field(
        default_factory=list, max_length=1024, json_schema_extra=ATOMIC_LIST
    )
    """The clients of the episode."""


class TaskEvent(Model):
    """The event that caused the task."""

    id: str = Field(max_length=64)
    """The ID of the episode."""
    rule: ObjectName
    """The name of the EventRule."""
    action: ObjectName
    """The name of the rule's action."""
    subject: str = Field(max_length=512)
    """The subject of the episode, as in the event's key, e.g. car1+car2."""
    onset_time: Time
    """The time at which the rule's condition became true."""
    start_time: Time
    """The start of the episode."""
    classification: Classification | None = None
    """The classification of the rule."""
    values: dict[str, NestedValue] = Field(default_factory=dict, max_length=256)
    """The values of the rule's variables at the start of the episode. If they exceed 64 KiB in total, the detector
    omits the largest ones."""


class ApplicationTaskSpec(Model):
    """One demand for an application, and its cause."""

    template_name: TemplateName = Field(json_schema_extra=immutable(_IMMUTABLE))
    """The name of the ApplicationTemplate, in the same namespace. Immutable."""
    operation: Operation = Field(default=Operation.DEPLOY, description=MEANING, json_schema_extra=immutable(_IMMUTABLE))
    priority: int = Field(default=0, ge=-1_000_000, le=1_000_000, json_schema_extra=immutable(_IMMUTABLE))
    """The priority of the task. Higher priorities come first; tasks of equal priority are ordered by creation time,
    then by name. Immutable."""
    parameters: dict[Identifier, NestedValue] = Field(default_factory=dict, max_length=64)
    """The values for the template's parameters, at most 64 KiB in total. Can change while the task is live."""
    requester: Requester = Field(default=Requester(), json_schema_extra=immutable(_IMMUTABLE))
    """The holder that emitted the task, and the clients of the episode. Immutable."""
    event: TaskEvent | None = None
    """The event that caused the task. Immutable."""
    end_time: Time | None = None
    """When the demand ended. Setting it ends the demand at once, even with a future time. Immutable once set."""


class TaskPhase(StrEnum):
    """A one-word summary of a task's state."""

    PENDING = "Pending"
    WAITING = "Waiting"
    REFUSED = "Refused"
    ACTIVE = "Active"
    READY = "Ready"
    SUSPENDED = "Suspended"
    LAPSED = "Lapsed"
    FINISHED = "Finished"


class ApplicationTaskStatus(Model):
    """The observed state of the demand."""

    phase: TaskPhase | None = None
    """A one-word summary of the state."""
    instance_name: str | None = Field(default=None, max_length=63)
    """The name of the ApplicationInstance that serves the task."""
    message: str | None = Field(default=None, max_length=512)
    """Why the task is waiting or does not count. Absent in normal operation."""
    observed_generation: Count = 0
    """The metadata.generation that the status was computed from."""
    applied_time: Time | None = None
    """The time at which the task's values were first applied to the instance."""
    ready_time: Time | None = None
    """The time at which the instance was first ready for the task."""
    conditions: Conditions = Field(default_factory=list)
    """Accepted: the demand counts. Applied, Ready: the current state of the task's instance. Stalled: the task is
    refused, for the reason in its message. Finished: the task has ended; Applied and Ready are removed."""


class ApplicationTask(Kind):
    """A demand for an application. It is live from its creation until its end."""

    plural: ClassVar[str] = "applicationtasks"
    short_name: ClassVar[str] = "apptask"
    printer_columns: ClassVar[list[dict[str, Any]]] = [
        {"name": "Template", "type": "string", "jsonPath": ".spec.templateName"},
        {"name": "Operation", "type": "string", "jsonPath": ".spec.operation"},
        {"name": "Rule", "type": "string", "jsonPath": ".spec.event.rule"},
        {"name": "Subject", "type": "string", "jsonPath": ".spec.event.subject"},
        {"name": "Instance", "type": "string", "jsonPath": ".status.instanceName"},
        {"name": "Phase", "type": "string", "jsonPath": ".status.phase"},
        {"name": "Priority", "type": "integer", "jsonPath": ".spec.priority", "priority": 1},
        {"name": "Holder", "type": "string", "jsonPath": ".spec.requester.holder", "priority": 1},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": ".status.message"},
    ]
    selectable_fields: ClassVar[list[str]] = [
        ".spec.templateName",
        ".spec.requester.detectorName",
        ".status.instanceName",
    ]
    object_validations: ClassVar[list[JsonDict]] = [
        validation(
            "has(self.spec.event) == has(oldSelf.spec.event)"
            " && (!has(self.spec.event) || self.spec.event == oldSelf.spec.event)",
            _IMMUTABLE,
            ".spec.event",
            "Forbidden",
        ),
        validation(
            "!has(oldSelf.spec.endTime) || (has(self.spec.endTime) && self.spec.endTime == oldSelf.spec.endTime)",
            "is immutable once set: create another task",
            ".spec.endTime",
            "Forbidden",
        ),
    ]

    kind: str = "ApplicationTask"
    spec: ApplicationTaskSpec
    """The demand and its cause."""
    status: ApplicationTaskStatus | None = None
    """The observed state of the demand."""
