"""The trigger action: makes another system record while an episode lasts."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

from pydantic import Field, field_validator

from wayside.api.actions.http import HttpAccess, HttpUrl
from wayside.api.actions.window import WindowClients
from wayside.api.base import (
    SET_LIST,
    ClientName,
    Duration,
    JsonValue,
    Model,
    ObjectName,
    PositiveDuration,
)
from wayside.api.constraints import constraint, exactly_one
from wayside.api.freedata import FreeData, NamedData
from wayside.api.stream import Layout

ServiceName = Annotated[
    str, Field(min_length=1, max_length=255, pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*$")
]
"""A ROS 2 service, e.g. /rosbag2_recorder/snapshot."""

ServiceType = Annotated[
    str, Field(min_length=1, max_length=255, pattern=r"^[A-Za-z][A-Za-z0-9_]*/srv/[A-Za-z][A-Za-z0-9_]*$")
]
"""The type of a ROS 2 service, e.g. rosbag2_interfaces/srv/Snapshot."""

_ANY_CALL = constraint(
    "has(self.start) || has(self.stop)",
    "give start, stop or both",
    holds=lambda trigger: trigger.start is not None or trigger.stop is not None,
)


class TriggerDetector(Model):
    """A recording by another detector of the same Zenoh network, which must allow it (spec.recordings.onRequest)."""

    name: str = Field(min_length=1, max_length=512, pattern=r"^([A-Za-z0-9_.-]{1,253}|.*[$][{].*)$")
    """The holder name of the other detector: the name of the Detector, or <detector>.<pod> for a Sidecar. It can
    contain ${…} with the rule's variables, e.g. recorder.${client}."""
    streams: list[ObjectName] | None = Field(default=None, min_length=1, max_length=128, json_schema_extra=SET_LIST)
    """The streams of the other detector. Default: all streams that it records on request."""
    clients: WindowClients = WindowClients.ALL
    """All: every client that the other detector knows. Subjects: the clients of the episode."""
    with_clients: list[ClientName] = Field(default_factory=list, max_length=64, json_schema_extra=SET_LIST)
    """Additional clients. Only with `clients: Subjects`."""
    before: Duration = Duration("0s")
    """The length of the recording before the onset. The buffer of the other detector limits it."""
    after: Duration = Duration("0s")
    """The length of the recording after the end of the episode."""


class ServiceCall(Model):
    """A call of a ROS 2 service."""

    service: ServiceName
    """The name of the service, e.g. /rosbag2_recorder/resume."""
    type: ServiceType
    """The type of the service, e.g. rosbag2_interfaces/srv/Resume."""
    definition: str | None = Field(default=None, max_length=16_384)
    """The definition of the type, in the format of .srv files. Not needed for the services of the rosbag2 recorder and
    of std_srvs (ROS 2 Jazzy)."""
    request: NamedData = Field(default_factory=dict)
    """The fields of the request. Values can contain ${…} with the rule's variables at the start of the episode. Omitted
    fields are zero or empty."""


class TriggerRos2(Model):
    """Calls of ROS 2 services over Zenoh, at the start and the end of the episode."""

    constraints = (
        _ANY_CALL,
        constraint(
            "!has(self.domain) || !has(self.layout) || self.layout == 'RmwZenoh'",
            "domain is valid only with layout RmwZenoh: remove it",
            ".domain",
            "Forbidden",
            holds=lambda trigger: trigger.domain is None or trigger.layout is Layout.RMW_ZENOH,
        ),
    )

    layout: Layout = Layout.RMW_ZENOH
    """RmwZenoh: nodes that use rmw_zenoh. Plain: nodes behind zenoh-bridge-ros2dds."""
    domain: int | None = Field(default=None, ge=0, le=232)
    """With layout RmwZenoh: the ROS domain ID of the nodes. Default: 0."""
    start: ServiceCall | None = None
    """The call at the start of the episode. With both start and stop, overlapping episodes share one recording: it
    starts with the first and stops with the last."""
    stop: ServiceCall | None = None
    """The call at the end of the episode."""

    @property
    def calls(self) -> Mapping[str, ServiceCall]:
        """The calls by field name, start and stop."""
        return {name: call for name, call in (("start", self.start), ("stop", self.stop)) if call is not None}


class HttpMethod(StrEnum):
    """The method of an HTTP request."""

    POST = "POST"
    PUT = "PUT"
    PATCH = "PATCH"
    DELETE = "DELETE"


class HttpCall(Model):
    """One HTTP request. Its header Idempotency-Key consists of the recording's ID and .start or .stop."""

    method: HttpMethod = HttpMethod.POST
    """The method: POST, PUT, PATCH or DELETE."""
    url: HttpUrl
    """The URL, e.g. https://recorder/recordings/{id}. {id} is replaced with the ID of the recording."""
    body: FreeData | None = None
    """The JSON body. Values can contain ${…} with the rule's variables at the start of the episode. Default: an object
    with id, do (start or stop), maxDuration, and event (the CloudEvent of the start)."""

    @field_validator("url")
    @classmethod
    def _fixed(cls, url: str) -> str:
        if "${" in url:
            raise ValueError(
                "must not contain ${…}, which could change the target: use {id}, or move the values to body"
            )
        return url


class TriggerHttp(HttpAccess):
    """Requests to an HTTP endpoint, at the start and the end of the episode."""

    constraints = (*HttpAccess.constraints, _ANY_CALL)

    start: HttpCall | None = None
    """The request at the start of the episode."""
    stop: HttpCall | None = None
    """The request at the end of the episode."""

    @property
    def calls(self) -> Mapping[str, HttpCall]:
        """The calls by field name, start and stop."""
        return {name: call for name, call in (("start", self.start), ("stop", self.stop)) if call is not None}


class TriggerAction(Model):
    """Makes another system record, from the start of the episode to its end."""

    constraints = (exactly_one("detector", "ros2", "http"),)

    detector: TriggerDetector | None = None
    """Requests a recording from another detector."""
    ros2: TriggerRos2 | None = None
    """Calls ROS 2 services, e.g. those of the rosbag2 recorder."""
    http: TriggerHttp | None = None
    """Sends requests to an HTTP endpoint."""
    max_duration: PositiveDuration = PositiveDuration("10m")
    """The maximum duration of the recording. Another detector enforces the limit itself. For ROS 2 services and HTTP
    endpoints, this detector sends the stop when the time is over, and must be running then."""
    give_up_after: PositiveDuration = PositiveDuration("5m")
    """How long to retry a start or stop that the other system does not confirm."""
    timeout: PositiveDuration = PositiveDuration("3s")
    """How long to wait for a reply over Zenoh."""

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """The values that are rendered for each episode."""
        if self.detector is not None:
            return {"detector": {"name": self.detector.name}}
        if self.ros2 is not None:
            return {"ros2": {name: {"request": call.request} for name, call in self.ros2.calls.items()}}
        assert self.http is not None  # noqa: S101  one of them is given
        return {"http": {name: {"body": call.body} for name, call in self.http.calls.items() if call.body is not None}}
