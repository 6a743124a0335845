"""The notify action: somebody is told of a rule's episodes, over HTTP, by an Alertmanager or on a Zenoh key."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.actions.http import HttpAccess, HttpUrl, SecretKey
from wayside.api.base import Duration, Identifier, JsonValue, Model, PositiveDuration, validations

_TLS_ONCE = "give tls or tlsSecret, not both"
_URL_ONCE = "give exactly one of url and urlSecret"
_TARGETS = ("http", "alertmanager", "zenoh")
_ONE_TARGET = "give exactly one of http, alertmanager and zenoh"
_ALERTS = "an Alertmanager groups by itself and is told of starts and ends: leave out grouping and events"
_NO_LABEL = "grouping.by names a label that labels does not have"

Template = Annotated[str, Field(min_length=1, max_length=4096)]
"""Text with ${…} over the rule's variables at the start of the episode."""


class Moment(StrEnum):
    """Of which events somebody is told."""

    STARTED = "Started"
    ENDED = "Ended"


class ContentMode(StrEnum):
    """How a CloudEvent travels in an HTTP request (CloudEvents' HTTP protocol binding 1.0, section 3)."""

    STRUCTURED = "Structured"
    BINARY = "Binary"


class NotifyHttp(HttpAccess):
    """An endpoint that takes CloudEvents by POST."""

    model_config = validations(
        ("!(has(self.tls) && has(self.tlsSecret))", _TLS_ONCE), ("has(self.url) != has(self.urlSecret)", _URL_ONCE)
    )

    url: HttpUrl | None = Field(default=None, description="The endpoint, e.g. https://events.example/city.")
    url_secret: SecretKey | None = Field(
        default=None, description="The Secret that holds the URL, where knowing it is all that one needs."
    )
    mode: ContentMode = Field(
        default=ContentMode.STRUCTURED,
        description="Structured: the whole event is the body. Binary: its data is the body, the rest are headers.",
    )

    @model_validator(mode="after")
    def _one_url(self) -> NotifyHttp:
        if (self.url is None) == (self.url_secret is None):
            raise ValueError(_URL_ONCE)
        return self


class NotifyAlertmanager(HttpAccess):
    """An Alertmanager, or what takes alerts as it does (API v2)."""

    url: HttpUrl = Field(
        description="Where it is, e.g. http://alertmanager:9093; /api/v2/alerts is added.",
    )
    repeat: PositiveDuration = Field(
        default=PositiveDuration("1m"),
        description="An alert is sent again so often while its episode lasts. Without word for four times as long, the "
        "Alertmanager takes it to be over.",
    )


class NotifyZenoh(Model):
    """A key of the detector's Zenoh session."""

    key: str = Field(
        min_length=1,
        max_length=255,
        pattern=r"^[^/*$#?]+(/[^/*$#?]+)*$",
        description="Where the event is published, beside its own key, e.g. city/alerts.",
    )


class Grouping(Model):
    """Many events, one message."""

    wait: PositiveDuration = Field(
        default=PositiveDuration("10s"),
        description="A message is sent so long after the first event that belongs in it.",
    )
    by: list[Identifier] = Field(
        default_factory=list,
        max_length=8,
        description="Names of labels: events with the same values share messages. Default: all events of the rule do.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )
    maximum: int = Field(default=20, ge=1, le=1000, description="So many events are given in full; all are counted.")


class Rate(Model):
    """How often somebody is told at most. What comes beyond waits."""

    messages: int = Field(ge=1, le=100_000, description="So many messages, retries included.")
    per: PositiveDuration = Field(default=PositiveDuration("1m"), description="Within this time.")


class Notify(Model):
    """Tell somebody of the rule's episodes."""

    model_config = validations(
        (f"[{', '.join(f'has(self.{kind})' for kind in _TARGETS)}].filter(given, given).size() == 1", _ONE_TARGET),
        ("!has(self.alertmanager) || !(has(self.grouping) || has(self.events))", _ALERTS),
    )

    http: NotifyHttp | None = Field(default=None, description="An endpoint that takes CloudEvents.")
    alertmanager: NotifyAlertmanager | None = Field(
        default=None, description="An Alertmanager: an alert fires while the episode lasts."
    )
    zenoh: NotifyZenoh | None = Field(default=None, description="A Zenoh key.")
    events: list[Moment] | None = Field(
        default=None,
        min_length=1,
        max_length=2,
        description="Of which events. Default: Started and Ended.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )
    title: Template | None = Field(default=None, description="A headline, with ${…}; the summary of an alert.")
    text: Template | None = Field(default=None, description="What to tell, with ${…}; the description of an alert.")
    labels: dict[Identifier, Annotated[str, Field(max_length=1024)]] = Field(
        default_factory=dict,
        max_length=32,
        description="Facts for whoever sorts what comes in, such as severity, with ${…}; the labels of an alert.",
    )
    grouping: Grouping | None = Field(default=None, description="Many events, one message. Default: one message each.")
    rate: Rate | None = Field(default=None, description="How often at most. Default: as it comes.")
    waiting: int = Field(
        default=1000,
        ge=1,
        le=100_000,
        description="So many messages wait at most; what finds no place is a dead letter.",
    )
    give_up_after: Duration = Field(
        default=Duration("1h"),
        description="What could not be delivered for so long, in several attempts, is a dead letter.",
    )

    @model_validator(mode="after")
    def _coherent(self) -> Notify:
        if sum(getattr(self, kind) is not None for kind in _TARGETS) != 1:
            raise ValueError(_ONE_TARGET)
        if self.alertmanager is not None and (self.grouping is not None or self.events is not None):
            raise ValueError(_ALERTS)
        if self.grouping is not None and not set(self.grouping.by) <= set(self.labels):
            raise ValueError(_NO_LABEL)
        return self

    @property
    def moments(self) -> frozenset[Moment]:
        """The events of which somebody is told."""
        return frozenset(Moment if self.events is None else self.events)

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """What is rendered for each episode, by field."""
        given = {"title": self.title, "text": self.text, "labels": self.labels or None}
        return {name: value for name, value in given.items() if value is not None}
