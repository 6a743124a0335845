"""ApplicationTask: one demand on an application, and why."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

from wayside.api.base import (
    Condition,
    Identifier,
    JsonValue,
    Kind,
    Model,
    ObjectName,
    TemplateName,
    Time,
    conditions_field,
)
from wayside.api.classification import Classification
from wayside.api.operation import MEANING, Operation

MAXIMUM_PARAMETER_BYTES = 64 * 1024
"""The most that a task's parameters may take as JSON; the manager refuses more."""

Value = Annotated[
    JsonValue,
    Field(json_schema_extra={"maxLength": MAXIMUM_PARAMETER_BYTES, "maxItems": 4096, "maxProperties": 1024}),
]
"""A JSON value that the API server bounds on its first level: what is deeper inside, no schema of a CRD can."""

HOLDER_LABEL = "wayside.dev/holder"
RULE_DIGEST_ANNOTATION = "wayside.dev/rule-digest"
"""Digest of the rule's semantics (see `EventRule.semantics`) under which the episode started."""
TRACEPARENT_ANNOTATION = "wayside.dev/traceparent"
"""Where the task stands in a trace, as W3C's header `traceparent` says it; absent where traces are off."""

Holder = Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$")]


class Requester(Model):
    """On whose behalf the task was emitted, and by whom."""

    detector: ObjectName | None = Field(default=None, description="The Detector; absent in a person's task.")
    holder: Holder | None = Field(
        default=None,
        description="Who emitted the task and keeps it alive by the Lease wayside-<holder>. "
        "A task without a holder never lapses.",
    )
    subjects: list[Annotated[str, Field(max_length=256)]] = Field(
        default_factory=list,
        max_length=1024,
        description="The clients that the episode is about.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )


class TaskEvent(Model):
    """The event that the task follows from."""

    id: str = Field(max_length=64, description="The episode's id.")
    rule: ObjectName = Field(description="The EventRule.")
    action: ObjectName = Field(description="The rule's action.")
    subject: str = Field(max_length=512, description="The episode's subject, as in the event's key, e.g. car1+car2.")
    onset_time: Time = Field(description="When the rule's condition began to hold.")
    start_time: Time = Field(description="When the episode started.")
    classification: Classification | None = Field(default=None, description="The rule's classification.")
    values: dict[str, Value] = Field(
        default_factory=dict, max_length=256, description="The values of the rule's variables at the start."
    )


class ApplicationTaskSpec(Model):
    """What is wanted and why."""

    template: TemplateName = Field(description="The ApplicationTemplate, in the task's namespace.")
    operation: Operation = Field(default=Operation.DEPLOY, description=MEANING)
    priority: int = Field(default=0, ge=-1_000_000, le=1_000_000, description="Tasks of higher priority come first.")
    parameters: dict[Identifier, Value] = Field(
        default_factory=dict,
        max_length=64,
        description="Values for the template's parameters; at most 64 KiB in all. May change while the task lives.",
    )
    requester: Requester = Field(default=Requester(), description="On whose behalf, and by whom.")
    event: TaskEvent | None = Field(default=None, description="The event that the task follows from.")
    end_time: Time | None = Field(
        default=None, description="Absent while the demand holds; set once, when it has ended."
    )


class TaskPhase(StrEnum):
    """A task's state in one word."""

    PENDING = "Pending"
    WAITING = "Waiting"
    REFUSED = "Refused"
    ACTIVE = "Active"
    READY = "Ready"
    SUSPENDED = "Suspended"
    LAPSED = "Lapsed"
    FINISHED = "Finished"


class ApplicationTaskStatus(Model):
    """What became of the demand."""

    phase: TaskPhase | None = Field(default=None, description="The state in one word.")
    instance: str | None = Field(default=None, max_length=63, description="The ApplicationInstance that serves it.")
    message: str | None = Field(
        default=None, max_length=512, description="What it waits for or why it does not count; absent when all is well."
    )
    observed_generation: int = Field(default=0, description="The generation that the status speaks of.")
    applied_time: Time | None = Field(
        default=None, description="When its instance had its values applied for the first time."
    )
    ready_time: Time | None = Field(default=None, description="When its instance was ready for it for the first time.")
    conditions: list[Condition] = conditions_field(
        "Accepted: the demand counts. Applied, Ready: its instance is, now. Stalled: it is refused, and waiting does "
        "not help. Finished: it is over, and Applied and Ready are gone."
    )


class ApplicationTask(Kind):
    """A demand on an application that holds from its creation until its end."""

    plural: ClassVar[str] = "applicationtasks"
    short_name: ClassVar[str] = "apptask"
    printer_columns: ClassVar[list[dict[str, str]]] = [
        {"name": "Template", "type": "string", "jsonPath": ".spec.template"},
        {"name": "Operation", "type": "string", "jsonPath": ".spec.operation"},
        {"name": "Rule", "type": "string", "jsonPath": ".spec.event.rule"},
        {"name": "Subject", "type": "string", "jsonPath": ".spec.event.subject"},
        {"name": "Instance", "type": "string", "jsonPath": ".status.instance"},
        {"name": "Phase", "type": "string", "jsonPath": ".status.phase"},
        {"name": "Priority", "type": "integer", "jsonPath": ".spec.priority", "priority": "1"},
        {"name": "Holder", "type": "string", "jsonPath": ".spec.requester.holder", "priority": "1"},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": ".status.message"},
    ]
    selectable_fields: ClassVar[list[str]] = [".spec.template", ".spec.requester.detector", ".status.instance"]
    object_validations: ClassVar[list[dict[str, str]]] = [
        {
            "rule": "self.spec.template == oldSelf.spec.template && self.spec.priority == oldSelf.spec.priority"
            " && self.spec.operation == oldSelf.spec.operation"
            " && self.spec.requester == oldSelf.spec.requester"
            " && has(self.spec.event) == has(oldSelf.spec.event)"
            " && (!has(self.spec.event) || (self.spec.event.id == oldSelf.spec.event.id"
            " && self.spec.event.rule == oldSelf.spec.event.rule"
            " && self.spec.event.action == oldSelf.spec.event.action"
            " && self.spec.event.subject == oldSelf.spec.event.subject"
            " && self.spec.event.onsetTime == oldSelf.spec.event.onsetTime"
            " && self.spec.event.startTime == oldSelf.spec.event.startTime"
            " && has(self.spec.event.classification) == has(oldSelf.spec.event.classification)"
            " && (!has(self.spec.event.classification)"
            " || self.spec.event.classification == oldSelf.spec.event.classification)))",
            # CEL does not see event.values, whose items may be of any type.
            "message": "only spec.parameters may change, and spec.endTime be set (spec.event.values is not looked at): "
            "end this task and create another",
        },
        {
            "rule": "!has(oldSelf.spec.endTime)"
            " || (has(self.spec.endTime) && self.spec.endTime == oldSelf.spec.endTime)",
            "message": "spec.endTime is set once: a demand that ended does not come back; create another task",
        },
    ]

    kind: str = "ApplicationTask"
    spec: ApplicationTaskSpec = Field(description="What is wanted and why.")
    status: ApplicationTaskStatus | None = Field(default=None, description="What became of the demand.")
