"""Streams: one kind of data of every client, where it comes from, how it is read and how much of it is kept."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.base import (
    Duration,
    Expression,
    Key,
    Model,
    ObjectName,
    PositiveDuration,
    PositiveQuantity,
    validations,
)
from wayside.api.source import ZENOH


class Encoding(StrEnum):
    """How the bytes of a stream are to be read."""

    CDR = "cdr"
    JSON = "json"
    UPER = "uper"
    CBOR = "cbor"
    RAW = "raw"


class Layout(StrEnum):
    """What the keys of a stream are made of."""

    PLAIN = "Plain"
    RMW_ZENOH = "RmwZenoh"


MessageType = Annotated[str, Field(max_length=255, pattern=r"^[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*$")]
"""A ROS 2 message type, e.g. geometry_msgs/msg/PoseStamped."""


class MessageDefinition(Model):
    """What a ROS 2 message type is made of."""

    name: MessageType = Field(description="The type, e.g. my_package/msg/Track.")
    definition: str = Field(
        max_length=65_536,
        description="As its .msg file holds it. What it refers to has a definition of its own in messages, or follows "
        "behind a line of = and `MSG: <type>`, as `ros2 bag` records it.",
    )


class History(Model):
    """How much of what publishers remember is asked for; without limits, all of it."""

    samples: int | None = Field(default=None, ge=1, le=100_000, description="The newest so many samples on each key.")
    age: PositiveDuration | None = Field(default=None, description="Samples that are not older than this.")


class StreamBuffer(Model):
    """How much of a stream is kept, per client."""

    duration: PositiveDuration | None = Field(default=None, description="Samples older than this are forgotten.")
    bytes: PositiveQuantity | None = Field(
        default=None, description="The oldest samples beyond this size are forgotten."
    )
    count: int | None = Field(
        default=None, ge=1, le=1_000_000, description="The oldest samples beyond this number are forgotten."
    )


TRANSFORMS = "tf2_msgs/msg/TFMessage"


class Stream(Model):
    """One kind of data of every client."""

    model_config = validations(
        (
            "self.encoding == 'uper' || (self.encoding == 'cdr') == has(self.type)",
            "type is for cdr streams, and they need it, e.g. geometry_msgs/msg/PoseStamped; and for uper streams",
        ),
        (
            "!has(self.type) || (self.encoding == 'uper') == self.type.startsWith('etsi/')",
            "the type of a cdr stream is a ROS 2 message, that of a uper stream an ETSI ITS message, e.g. etsi/cam",
        ),
        (
            "self.key.contains('${client:') != has(self.client)",
            "key must capture the client, as ${client:*}, or client must name it; not both",
        ),
        (
            "!has(self.framePrefix) || (has(self.type) && self.type == 'tf2_msgs/msg/TFMessage')",
            "framePrefix is for streams of type tf2_msgs/msg/TFMessage",
        ),
        (
            "self.layout != 'RmwZenoh' || self.encoding in ['cdr', 'raw']",
            "layout RmwZenoh is of ROS 2 messages: encoding must be cdr or raw",
        ),
        (
            "self.layout != 'RmwZenoh' || self.source == 'zenoh'",
            "layout RmwZenoh is for streams whose source is zenoh: remove one of them",
        ),
        ("!has(self.domain) || self.layout == 'RmwZenoh'", "domain is for streams with layout RmwZenoh: remove it"),
    )

    name: ObjectName = Field(description="The name by which rules refer to the stream.")
    key: Key = Field(
        description="The Zenoh key expression in key-format notation: ${client:*} captures the client's name, "
        "e.g. vehicles/${client:*}/pose. A ROS topic may be written with or without its leading slash.",
    )
    source: ObjectName = Field(
        default=ZENOH, description="Where the samples come from: zenoh, or the name of one of the Detector's sources."
    )
    history: History | None = Field(
        default=None,
        description="Over Zenoh: what was published before the detector or its publisher came is asked for, of "
        "Advanced Publishers that remember it.",
    )
    recover: bool = Field(
        default=False,
        description="Over Zenoh: samples lost on the way are asked for again, of Advanced Publishers that number and "
        "remember them; what stays lost is counted.",
    )
    layout: Layout = Field(
        default=Layout.PLAIN,
        description="Plain: samples come on the key itself, also with zenoh-bridge-ros2dds. RmwZenoh: on the keys of "
        "rmw_zenoh nodes, which put the domain before the topic, and type and type hash after it; key is the topic.",
    )
    domain: int | None = Field(
        default=None,
        ge=0,
        le=232,
        description="The ROS domain that a RmwZenoh stream is taken from. Default: every domain.",
    )
    client: str | None = Field(
        default=None,
        min_length=1,
        max_length=512,
        pattern=r"^([A-Za-z0-9._:-]{1,63}|.*[$][{].*)$",
        description="The client that the data belongs to, where the key captures none: a name, or one made from the "
        "message, as its-${msg.header.stationId}, with CEL over msg, and key for what the key captures.",
    )
    encoding: Encoding = Field(description="cdr (ROS 2 messages), json, cbor, uper (ETSI ITS messages), or raw: bytes.")
    type: str | None = Field(
        default=None,
        max_length=255,
        pattern=r"^([A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*|etsi/[a-z]+)$",
        description="The ROS 2 message type of a cdr stream, e.g. geometry_msgs/msg/PoseStamped; or which ETSI ITS "
        "messages a uper stream has, e.g. etsi/cam (default: of all kinds).",
    )
    stamp: Expression | None = Field(
        default=None,
        description="CEL over msg: the sender's time in seconds since the epoch, e.g. msg.time_ms / 1000; or "
        "sample.received, the receive time (t of JSON lines). Default: header.stamp where the type has one, the time "
        "of generation in an ETSI ITS message, else none.",
    )
    stale_after: Duration | str | None = Field(
        default=None,
        description="Signals of the stream are unknown when its newest sample is older than this. "
        "Default: 5s, or clientTimeout if that is shorter. Never: not at all, for latched topics.",
        json_schema_extra={"type": "string", "pattern": f"^({PositiveDuration.pattern}|Never)$", "maxLength": 20},
    )
    buffer: StreamBuffer = Field(
        default=StreamBuffer(), description="How much is kept; the Detector's buffer where absent."
    )

    latched: bool = Field(
        default=False,
        description="What was said last holds until it is said anew, e.g. /tf_static, a map: the newest sample of each "
        "key is kept beyond the buffer's duration, staleAfter is Never if not given, and a replay takes it first.",
    )
    frame_prefix: str | None = Field(
        default=None,
        min_length=1,
        max_length=128,
        description="Of a tf2_msgs/msg/TFMessage stream: what its frames' names begin with and lose, so that they are "
        "the same for every client; ${client} in it is the client's name, e.g. ${client}/.",
    )

    @model_validator(mode="after")
    def _coherent(self) -> Stream:
        if self.encoding is Encoding.CDR and self.type is None:
            raise ValueError("a cdr stream needs its message type: give type, e.g. geometry_msgs/msg/PoseStamped")
        if self.encoding not in (Encoding.CDR, Encoding.UPER) and self.type is not None:
            raise ValueError(f"a {self.encoding} stream has no type: remove it")
        if self.layout is Layout.RMW_ZENOH and self.encoding not in (Encoding.CDR, Encoding.RAW):
            raise ValueError(
                f"layout RmwZenoh is of ROS 2 messages: encoding must be cdr or raw, is {self.encoding}; "
                "correct it, or remove layout"
            )
        if self.layout is Layout.RMW_ZENOH and self.source != ZENOH:
            raise ValueError(f"layout RmwZenoh is for samples from zenoh, not {self.source}: remove one of them")
        if self.domain is not None and self.layout is not Layout.RMW_ZENOH:
            raise ValueError("domain is for streams with layout RmwZenoh: remove it")
        if self.type is not None and (self.encoding is Encoding.UPER) != self.type.startswith("etsi/"):
            example = "etsi/cam" if self.encoding is Encoding.UPER else "geometry_msgs/msg/PoseStamped"
            raise ValueError(f"{self.type} is no type of {self.encoding} streams: give one such as {example}")
        captures = "${client:" in self.key
        if captures and self.client is not None:
            raise ValueError("key captures the client and client names one: remove one of them")
        if not captures and self.client is None:
            raise ValueError("key captures no client: write ${client:*} where its name stands, or give client")
        if self.frame_prefix is not None and not self.carries_transforms:
            raise ValueError("framePrefix is for streams of type tf2_msgs/msg/TFMessage: remove it")
        if self.stale_after is not None and self.stale_after != "Never":
            try:
                PositiveDuration.parse(self.stale_after)
            except ValueError as error:
                raise ValueError(f"staleAfter: {error}; or Never") from None
        return self

    @property
    def names_by_message(self) -> bool:
        """Whether `client` is a template over the message."""
        return self.client is not None and "${" in self.client

    @property
    def stale_after_ns(self) -> int | None:
        """Nanoseconds, or None where not given or Never (see `never_stale`)."""
        return None if self.stale_after is None or self.never_stale else Duration(self.stale_after).ns

    @property
    def never_stale(self) -> bool:
        """Whether the newest sample holds forever."""
        return self.stale_after == "Never" or (self.latched and self.stale_after is None)

    @property
    def carries_transforms(self) -> bool:
        """Whether its samples feed the transform trees of their clients."""
        return self.type == TRANSFORMS
