"""The notify action: notifications of a rule's episodes over HTTP, to an Alertmanager or on a Zenoh key."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.actions.http import HttpAccess, HttpUrl, SecretKey
from wayside.api.base import SET_LIST, Duration, Identifier, JsonValue, Model, PositiveDuration
from wayside.api.constraints import constraint, exactly_one

Template = Annotated[str, Field(min_length=1, max_length=4096)]
"""Text with ${…} over the rule's variables at the start of the episode."""


class NotifiedEvent(StrEnum):
    """The events that cause a notification."""

    STARTED = "Started"
    ENDED = "Ended"


class ContentMode(StrEnum):
    """How a CloudEvent travels in an HTTP request (CloudEvents' HTTP protocol binding 1.0, section 3)."""

    STRUCTURED = "Structured"
    BINARY = "Binary"


class NotifyHttp(HttpAccess):
    """An endpoint that receives CloudEvents by POST."""

    constraints = (*HttpAccess.constraints, exactly_one("url", "url_secret_key_ref"))

    url: HttpUrl | None = None
    """The URL of the endpoint, e.g. https://events.example/city."""
    url_secret_key_ref: SecretKey | None = None
    """The Secret key that contains the URL, if the URL itself grants access."""
    mode: ContentMode = ContentMode.STRUCTURED
    """Structured: the body is the whole event. Binary: the body is the data of the event; the attributes are
    headers."""


class NotifyAlertmanager(HttpAccess):
    """An Alertmanager, or a server with the same API (v2)."""

    url: HttpUrl
    """The base URL, e.g. http://alertmanager:9093. The path /api/v2/alerts is appended."""
    repeat: PositiveDuration = PositiveDuration("1m")
    """The interval at which an alert is sent again while its episode lasts. The alert resolves after four intervals
    without an update."""


class NotifyZenoh(Model):
    """A key of the detector's Zenoh session."""

    key: str = Field(min_length=1, max_length=255, pattern=r"^[^/*$#?]+(/[^/*$#?]+)*$")
    """The key on which the event is published, e.g. city/alerts, in addition to the usual key of the event."""


class Grouping(Model):
    """Groups several events into one message."""

    wait: PositiveDuration = PositiveDuration("10s")
    """How long a group collects events after its first one. Then its message is sent."""
    by: list[Identifier] = Field(default_factory=list, max_length=8, json_schema_extra=SET_LIST)
    """The names of labels. Events with the same values of these labels form a group. Default: all events of the rule
    form one group."""
    max_events: int = Field(default=20, ge=1, le=1000)
    """The maximum number of events that a message contains in full. Further events are only counted."""


class Rate(Model):
    """The maximum rate of messages. Further messages wait."""

    messages: int = Field(ge=1, le=100_000)
    """The maximum number of messages per period, retries included."""
    per: PositiveDuration = PositiveDuration("1m")
    """The period."""


class NotifyAction(Model):
    """Sends notifications of the rule's episodes."""

    constraints = (
        exactly_one("http", "alertmanager", "zenoh"),
        constraint(
            "!has(self.alertmanager) || !(has(self.grouping) || has(self.events))",
            "an Alertmanager groups alerts itself and receives all starts and ends: remove grouping and events",
            ".alertmanager",
            "Forbidden",
            holds=lambda notify: notify.alertmanager is None or (notify.grouping is None and notify.events is None),
        ),
    )

    http: NotifyHttp | None = None
    """An HTTP endpoint that receives CloudEvents."""
    alertmanager: NotifyAlertmanager | None = None
    """An Alertmanager. An alert fires while the episode lasts."""
    zenoh: NotifyZenoh | None = None
    """A Zenoh key on which the event is published."""
    events: list[NotifiedEvent] | None = Field(default=None, min_length=1, max_length=2, json_schema_extra=SET_LIST)
    """The events that cause a notification. Default: Started and Ended."""
    title: Template | None = None
    """The title of the message, or the summary of an alert. It can contain ${…}."""
    text: Template | None = None
    """The text of the message, or the description of an alert. It can contain ${…}."""
    labels: dict[Identifier, Annotated[str, Field(max_length=1024)]] = Field(default_factory=dict, max_length=32)
    """Labels by which the receiver can filter or route, such as severity. Values can contain ${…}. They become the
    labels of an alert."""
    grouping: Grouping | None = None
    """Groups several events into one message. Default: one message per event."""
    rate: Rate | None = None
    """The maximum rate of messages. Default: no limit."""
    waiting: int = Field(default=1000, ge=1, le=100_000)
    """The maximum number of queued messages. Further messages become dead letters."""
    give_up_after: Duration = Duration("1h")
    """How long to retry the delivery of a message. After that, the message becomes a dead letter."""

    @model_validator(mode="after")
    def _groups_by_labels(self) -> NotifyAction:
        if self.grouping is not None and not set(self.grouping.by) <= set(self.labels):
            raise ValueError(
                "grouping.by refers to a label that labels does not contain: add it to labels, or remove it"
            )
        return self

    @property
    def moments(self) -> frozenset[NotifiedEvent]:
        """The events that cause a notification."""
        return frozenset(NotifiedEvent if self.events is None else self.events)

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """The values that are rendered for each episode, by field."""
        given = {"title": self.title, "text": self.text, "labels": self.labels or None}
        return {name: value for name, value in given.items() if value is not None}
