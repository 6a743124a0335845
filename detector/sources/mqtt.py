"""The plugin `mqtt`: receives streams from topics of an MQTT broker.

A stream's key is its topic: `vehicles/${client:*}/pose` subscribes to `vehicles/+/pose`. If the connection is lost the
run fails, and the supervision reconnects and counts the failure.
"""

from __future__ import annotations

import ssl
from typing import Annotated, ClassVar

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.reasoncodes import ReasonCode
from pydantic import BaseModel, Field, field_validator

from detector.access import login, tls_files
from detector.sources.base import Feed, Source, SourceError
from wayside.api.access import Access

_POLL = 0.2
"""Maximum seconds of one wait for messages, and therefore until the source stops."""


class MqttParameters(Access):
    """The broker, and how to receive messages from it."""

    host: str = Field(min_length=1, max_length=255, description="The name or address of the broker.")
    port: int | None = Field(default=None, ge=1, le=65535, description="Default: 1883; with TLS 8883.")
    qos: Annotated[int, Field(ge=0, le=2)] = Field(
        default=0, description="0: at most once, 1: at least once, 2: exactly once."
    )
    client_id: str | None = Field(
        default=None,
        min_length=1,
        max_length=255,
        description=(
            "The client id at the broker. With it, the broker keeps messages of qos 1 and 2 while the detector "
            "is disconnected."
        ),
    )
    prefix: str = Field(default="", max_length=255, description="The prefix of the key in topics, e.g. / or plant1/.")
    keep_alive: int = Field(
        default=15,
        ge=1,
        le=3600,
        description=(
            "Keep-alive in seconds: a silent connection is probed after this time, and closed if it stays silent."
        ),
    )

    @field_validator("prefix")
    @classmethod
    def _plain(cls, prefix: str) -> str:
        if any(character in prefix for character in "+#"):
            raise ValueError("must not contain an MQTT wildcard: use wildcards in the keys of the streams")
        return prefix


class MqttSource(Source[MqttParameters]):
    """Messages of an MQTT broker."""

    Parameters: ClassVar[type[BaseModel]] = MqttParameters

    def run(self, feed: Feed) -> None:
        """Connect, subscribe, and receive messages until the connection is lost. Raises SourceError, AccessError."""
        parameters = self.parameters
        filters = [(parameters.prefix + topic_filter(each.pattern.expression), parameters.qos) for each in feed.streams]
        client = self._client()
        refused: list[str] = []

        def on_connect(client: Client, _: object, __: object, reason: ReasonCode, ___: object) -> None:
            if reason.is_failure:
                refused.append(f"the broker refused the connection: {reason}")
            else:
                client.subscribe(filters)

        def on_subscribe(_: object, __: object, ___: object, reasons: list[ReasonCode], ____: object) -> None:
            for (topic, _qos), reason in zip(filters, reasons, strict=False):
                if reason.is_failure:
                    refused.append(f"the broker refused the subscription to {topic}: {reason}")

        def on_message(_: object, __: object, message: MQTTMessage) -> None:
            feed.put(message.topic.removeprefix(parameters.prefix), bytes(message.payload))

        client.on_connect, client.on_subscribe, client.on_message = on_connect, on_subscribe, on_message
        try:
            client.connect(parameters.host, self._port, keepalive=parameters.keep_alive)
            while not feed.stopping:
                result = client.loop(_POLL)
                if refused:
                    raise SourceError(refused[0])
                if result != 0:
                    raise SourceError(f"lost the connection to {parameters.host}:{self._port}: {result.name}")
        except OSError as error:
            raise SourceError(f"cannot connect to {parameters.host}:{self._port}: {error}") from error
        finally:
            client.disconnect()

    @property
    def _port(self) -> int:
        encrypted = self.parameters.tls is not None or self.parameters.tls_secret_name is not None
        return self.parameters.port or (8883 if encrypted else 1883)

    def _client(self) -> Client:
        """Raises AccessError, SourceError."""
        parameters = self.parameters
        client = Client(
            CallbackAPIVersion.VERSION2,
            client_id=parameters.client_id or "",
            clean_session=parameters.client_id is None,
            protocol=MQTTProtocolVersion.MQTTv311,
        )
        client.connect_timeout = 1.5
        if (credentials := login(parameters, "parameters")) is not None:
            client.username_pw_set(credentials.username, credentials.password)
        files = tls_files(parameters, "parameters")
        if files is not None:
            try:
                client.tls_set_context(files.context())
            except (ssl.SSLError, OSError) as error:
                raise SourceError(f"parameters.tls: cannot use a certificate or key: {error}") from error
        return client


def topic_filter(expression: str) -> str:
    """A key expression as an MQTT topic filter for at least the same keys: the key of the stream decides."""
    chunks = expression.split("/")
    if "**" in chunks:
        chunks = [*chunks[: chunks.index("**")], "#"]
    return "/".join("+" if "*" in chunk else chunk for chunk in chunks)
