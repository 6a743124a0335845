"""The trigger action: another system records for as long as an episode lasts."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from wayside.api.actions.http import TLS_ONCE, HttpAccess, HttpUrl
from wayside.api.actions.window import WindowClients
from wayside.api.base import (
    ClientName,
    Duration,
    Identifier,
    JsonValue,
    Model,
    ObjectName,
    PositiveDuration,
    validations,
)
from wayside.api.stream import Layout

ServiceName = Annotated[
    str, Field(min_length=1, max_length=255, pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*$")
]
"""A ROS 2 service, e.g. /rosbag2_recorder/snapshot."""

ServiceType = Annotated[
    str, Field(min_length=1, max_length=255, pattern=r"^[A-Za-z][A-Za-z0-9_]*/srv/[A-Za-z][A-Za-z0-9_]*$")
]
"""What a ROS 2 service is of, e.g. rosbag2_interfaces/srv/Snapshot."""

_CALL = "give start, stop or both: else nothing is called"
_DOMAIN = "domain is for services with layout RmwZenoh: remove it"


class TriggerDetector(Model):
    """A recording by another detector of the same Zenoh network, which must allow it (spec.recordings.onRequest)."""

    name: str = Field(
        min_length=1,
        max_length=512,
        pattern=r"^([A-Za-z0-9_.-]{1,253}|.*[$][{].*)$",
        description="Which detector: its holder, that is the Detector's name or, of a Sidecar, <detector>.<pod>. "
        "With ${…} over the rule's variables, e.g. recorder.${client}.",
    )
    streams: list[ObjectName] | None = Field(
        default=None,
        min_length=1,
        max_length=128,
        description="Its streams. Default: all that it records on request.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )
    clients: WindowClients = Field(
        default=WindowClients.ALL,
        description="All: every client that it knows. Subjects: those that the episode is about.",
    )
    with_clients: list[ClientName] = Field(
        default_factory=list,
        max_length=64,
        description="With clients: Subjects, further ones.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )
    before: Duration = Field(
        default=Duration("0s"),
        description="From so long before the onset, as far as it still has it in its buffer.",
    )
    after: Duration = Field(default=Duration("0s"), description="Until so long after the episode's end.")


class ServiceCall(Model):
    """A call of a ROS 2 service."""

    service: ServiceName = Field(description="The service, e.g. /rosbag2_recorder/resume.")
    type: ServiceType = Field(description="Its type, e.g. rosbag2_interfaces/srv/Resume.")
    definition: str | None = Field(
        default=None,
        max_length=16_384,
        description="What the type is made of, as its .srv file holds it. Known are the services of rosbag2's recorder "
        "and of std_srvs, as of ROS 2 Jazzy.",
    )
    request: dict[Identifier, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="The request's fields, with ${…} over the rule's variables at the start of the episode; those that "
        "are not given are zero or empty.",
    )


class TriggerRos2(Model):
    """Services of ROS 2, called over Zenoh when the episode starts and ends."""

    model_config = validations(
        ("has(self.start) || has(self.stop)", _CALL),
        ("!has(self.domain) || !has(self.layout) || self.layout == 'RmwZenoh'", _DOMAIN),
    )

    layout: Layout = Field(
        default=Layout.RMW_ZENOH,
        description="RmwZenoh: nodes that use rmw_zenoh. Plain: nodes behind zenoh-bridge-ros2dds.",
    )
    domain: int | None = Field(
        default=None, ge=0, le=232, description="With layout RmwZenoh: the nodes' ROS domain. Default: 0."
    )
    start: ServiceCall | None = Field(
        default=None,
        description="Called at the start. With both, episodes that overlap are one recording: it is started with the "
        "first and stopped with the last.",
    )
    stop: ServiceCall | None = Field(default=None, description="Called at the end.")

    @model_validator(mode="after")
    def _coherent(self) -> TriggerRos2:
        if self.start is None and self.stop is None:
            raise ValueError(_CALL)
        if self.domain is not None and self.layout is not Layout.RMW_ZENOH:
            raise ValueError(_DOMAIN)
        return self

    @property
    def calls(self) -> Mapping[str, ServiceCall]:
        """The calls by the field that says them."""
        return {name: call for name, call in (("start", self.start), ("stop", self.stop)) if call is not None}


class HttpMethod(StrEnum):
    """What a request does."""

    POST = "POST"
    PUT = "PUT"
    PATCH = "PATCH"
    DELETE = "DELETE"


class HttpCall(Model):
    """One HTTP request. Its header Idempotency-Key is the recording's id and .start or .stop."""

    method: HttpMethod = Field(default=HttpMethod.POST, description="POST, PUT, PATCH or DELETE.")
    url: HttpUrl = Field(
        description="Where to; {id} in it becomes the recording's id, e.g. https://recorder/recordings/{id}."
    )
    body: dict[str, JsonValue] | None = Field(
        default=None,
        description="What is sent as JSON, with ${…} over the rule's variables at the start of the episode. Default: "
        "id, do (start or stop), maximumDuration and the CloudEvent of the start as event.",
        json_schema_extra={"type": "object", "x-kubernetes-preserve-unknown-fields": True, "maxProperties": 64},
    )

    @field_validator("url")
    @classmethod
    def _fixed(cls, url: str) -> str:
        if "${" in url:
            raise ValueError("takes no ${…}, since values could lead elsewhere: write {id}, and put values into body")
        return url


class TriggerHttp(HttpAccess):
    """Requests to an HTTP endpoint when the episode starts and ends."""

    model_config = validations(
        ("!(has(self.tls) && has(self.tlsSecret))", TLS_ONCE), ("has(self.start) || has(self.stop)", _CALL)
    )

    start: HttpCall | None = Field(default=None, description="Sent at the start.")
    stop: HttpCall | None = Field(default=None, description="Sent at the end.")

    @model_validator(mode="after")
    def _any_call(self) -> TriggerHttp:
        if self.start is None and self.stop is None:
            raise ValueError(_CALL)
        return self

    @property
    def calls(self) -> Mapping[str, HttpCall]:
        """The calls by the field that says them."""
        return {name: call for name, call in (("start", self.start), ("stop", self.stop)) if call is not None}


_SYSTEMS = ("detector", "ros2", "http")
_ONE = f"give exactly one of {', '.join(_SYSTEMS[:-1])} and {_SYSTEMS[-1]}"


class Trigger(Model):
    """Another system records, from the start of the episode to its end."""

    model_config = validations(
        (f"[{', '.join(f'has(self.{each})' for each in _SYSTEMS)}].filter(given, given).size() == 1", _ONE)
    )

    detector: TriggerDetector | None = Field(default=None, description="Another detector records.")
    ros2: TriggerRos2 | None = Field(default=None, description="Services of ROS 2 are called, e.g. of rosbag2.")
    http: TriggerHttp | None = Field(default=None, description="An HTTP endpoint is told.")
    maximum_duration: PositiveDuration = Field(
        default=PositiveDuration("10m"),
        description="The recording ends after so long even where nobody stops it. Another detector sees to that "
        "itself; ROS 2 services and HTTP endpoints are then told by this one, if it still runs.",
    )
    give_up_after: PositiveDuration = Field(
        default=PositiveDuration("5m"),
        description="A start or stop that is not confirmed is sent again, for so long.",
    )
    timeout: PositiveDuration = Field(
        default=PositiveDuration("3s"), description="How long one answer may take over Zenoh."
    )

    @model_validator(mode="after")
    def _one_system(self) -> Trigger:
        if sum(getattr(self, each) is not None for each in _SYSTEMS) != 1:
            raise ValueError(_ONE)
        return self

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """What is rendered for each episode."""
        if self.detector is not None:
            return {"detector": {"name": self.detector.name}}
        if self.ros2 is not None:
            return {"ros2": {name: {"request": call.request} for name, call in self.ros2.calls.items()}}
        assert self.http is not None  # noqa: S101  one of them is given
        return {"http": {name: {"body": call.body} for name, call in self.http.calls.items() if call.body is not None}}
