"""Streams: one kind of data of every client, with its source, encoding and buffer."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.access import FilePath
from wayside.api.base import (
    Duration,
    Expression,
    Key,
    Model,
    ObjectName,
    PositiveDuration,
    PositiveQuantity,
)
from wayside.api.constraints import constraint, exactly_one
from wayside.api.plugin import ZENOH


class Encoding(StrEnum):
    """The encoding of the payloads of a stream."""

    CDR = "cdr"
    JSON = "json"
    UPER = "uper"
    CBOR = "cbor"
    RAW = "raw"


class Layout(StrEnum):
    """The layout of the keys of a stream."""

    PLAIN = "Plain"
    RMW_ZENOH = "RmwZenoh"


MessageType = Annotated[str, Field(max_length=255, pattern=r"^[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*$")]
"""A ROS 2 message type, e.g. geometry_msgs/msg/PoseStamped."""


class MessageDefinition(Model):
    """The definition of a ROS 2 message type."""

    name: MessageType
    """The type, e.g. my_package/msg/Track."""
    definition: str = Field(max_length=65_536)
    """The definition in the format of .msg files. Each type that it refers to also needs a definition: either its own
    entry in messages, or a section of this text that begins with a line of = characters and a line `MSG: <type>`, as
    `ros2 bag` writes it."""


class Asn1Module(Model):
    """One or several ASN.1 modules, in the Detector itself or in a file."""

    constraints = (exactly_one("definition", "file"),)

    definition: str | None = Field(default=None, min_length=1, max_length=500_000)
    """The text of the modules."""
    file: FilePath | None = None
    """The path of a file with the modules, as the detector sees it: relative to its working directory, or on a mounted
    volume."""


class History(Model):
    """How much history to request from publishers. Without limits: all of it."""

    samples: int | None = Field(default=None, ge=1, le=100_000)
    """The maximum number of samples per key. The newest samples are requested."""
    age: PositiveDuration | None = None
    """The maximum age of the samples."""


class StreamBuffer(Model):
    """The limits of the stream's buffer, per client."""

    duration: PositiveDuration | None = None
    """How long samples are kept. Default: the Detector's buffer.duration."""
    bytes: PositiveQuantity | None = None
    """The maximum size. At the limit, the oldest samples are dropped."""
    count: int | None = Field(default=None, ge=1, le=1_000_000)
    """The maximum number of samples. At the limit, the oldest samples are dropped."""


class StreamPosition(Model):
    """The position of the client that a sample contains."""

    constraints = (
        constraint(
            "has(self.x) == has(self.y) && has(self.latitude) == has(self.longitude)"
            " && has(self.x) != has(self.latitude)"
            " && (has(self.x) || !(has(self.z) || has(self.yaw))) && (has(self.latitude) || !has(self.heading))",
            "give x and y (optionally z and yaw), or latitude and longitude (optionally heading)",
            holds=lambda position: any(
                needed <= position.axes.keys() - {"speed"} <= {*needed, *further}
                for needed, further in (({"x", "y"}, ("z", "yaw")), ({"latitude", "longitude"}, ("heading",)))
            ),
        ),
    )

    x: Expression | None = None
    """CEL over msg: the position on the first axis in metres, e.g. msg.pose.position.x."""
    y: Expression | None = None
    """CEL over msg: the position on the second axis in metres."""
    z: Expression | None = None
    """CEL over msg: the position on the third axis in metres."""
    yaw: Expression | None = None
    """CEL over msg: the direction in radians, counter-clockwise from the first axis, e.g. yaw(msg.pose.orientation)."""
    latitude: Expression | None = None
    """CEL over msg: the latitude in degrees north (WGS 84), e.g. msg.latitude."""
    longitude: Expression | None = None
    """CEL over msg: the longitude in degrees east (WGS 84), e.g. msg.longitude."""
    heading: Expression | None = None
    """CEL over msg: the direction in degrees, clockwise from north."""
    speed: Expression | None = None
    """CEL over msg: the speed in the direction of yaw or heading, in m/s."""

    @property
    def axes(self) -> dict[str, str]:
        """The expressions by axis."""
        return {axis: source for axis, source in self if source is not None}

    @property
    def geographic(self) -> bool:
        """Whether it is in degrees on the Earth; otherwise it is in metres."""
        return self.latitude is not None


TRANSFORMS = "tf2_msgs/msg/TFMessage"


class Stream(Model):
    """One kind of data that every client sends."""

    constraints = (
        constraint(
            "self.encoding == 'uper' || (self.encoding == 'cdr') == has(self.type)",
            "type is required with encoding cdr, optional with uper, and not allowed otherwise",
            ".type",
        ),
        constraint(
            "!has(self.type) || (self.encoding == 'uper') == self.type.startsWith('etsi/')",
            "type must be a ROS 2 message with encoding cdr, and an ETSI ITS message with uper, e.g. etsi/cam",
            ".type",
        ),
        constraint(
            "self.key.contains('${client:') != has(self.client)",
            "either key must capture the client with ${client:*}, or client must name it",
            ".client",
        ),
        constraint(
            "!has(self.framePrefix) || (has(self.type) && self.type == 'tf2_msgs/msg/TFMessage')",
            "framePrefix is valid only for streams of type tf2_msgs/msg/TFMessage: remove it",
            ".framePrefix",
            "Forbidden",
        ),
        constraint(
            "self.layout != 'RmwZenoh' || self.encoding in ['cdr', 'raw']",
            "layout RmwZenoh needs ROS 2 messages: encoding must be cdr or raw",
            ".layout",
        ),
        constraint(
            "self.layout != 'RmwZenoh' || self.source == 'zenoh'",
            "layout RmwZenoh needs source zenoh: remove layout or source",
            ".layout",
        ),
        constraint(
            "!has(self.domain) || self.layout == 'RmwZenoh'",
            "domain is valid only with layout RmwZenoh: remove it",
            ".domain",
            "Forbidden",
        ),
        constraint(
            "!has(self.items) || (has(self.client) && self.client.contains('item'))",
            "items needs client, a template that names the client of each item, e.g. ${item.id}",
            ".items",
        ),
        constraint(
            "!has(self.items) || !(self.latched || (has(self.type) && self.type == 'tf2_msgs/msg/TFMessage'))",
            "items is not valid for latched streams and transforms: remove items or latched",
            ".items",
            "Forbidden",
        ),
    )

    name: ObjectName
    """The name by which rules refer to the stream."""
    key: Key
    """The Zenoh key expression in key-format notation. ${client:*} captures the name of the client, e.g.
    vehicles/${client:*}/pose. The leading slash of a ROS topic is optional."""
    source: ObjectName = ZENOH
    """The source of the samples: zenoh, or the name of one of the Detector's sources."""
    history: History | None = None
    """Only with source zenoh: request samples that were published before the detector or its publisher started. Needs
    Advanced Publishers with a cache."""
    recover: bool = False
    """Only with source zenoh: request lost samples again. Needs Advanced Publishers with sequence numbers and a cache.
    Samples that cannot be recovered are counted."""
    layout: Layout = Layout.PLAIN
    """Plain: samples arrive on the key itself, also from zenoh-bridge-ros2dds. RmwZenoh: key is a ROS topic, and
    samples arrive on the keys of rmw_zenoh nodes, which add the domain before the topic, and the type and type hash
    after it."""
    domain: int | None = Field(default=None, ge=0, le=232)
    """The ROS domain ID of a stream with layout RmwZenoh. Default: every domain."""
    client: str | None = Field(
        default=None, min_length=1, max_length=512, pattern=r"^([A-Za-z0-9._:-]{1,63}|.*[$][{].*)$"
    )
    """The client of the samples, if the key does not capture it: a name, or a template over the message, such as
    its-${msg.header.stationId}. Expressions in the template can use msg, key (the captured chunks) and, with items,
    item."""
    items: Expression | None = None
    """CEL over msg: a list, e.g. msg.objects. Each item becomes a sample of the client that `client` names, e.g.
    ${item.id}, and expressions over the stream can use item and msg. Such a client is lost when its newest sample is
    older than staleAfter; a later item with the same name is a new client."""
    encoding: Encoding
    """The encoding of the payload: cdr (ROS 2 messages), json, cbor, uper (ETSI ITS messages), or raw (bytes)."""
    type: str | None = Field(
        default=None, max_length=255, pattern=r"^([A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*|etsi/[a-z]+)$"
    )
    """The message type. Required with encoding cdr: a ROS 2 type, e.g. geometry_msgs/msg/PoseStamped. Optional with
    encoding uper: an ETSI ITS message, e.g. etsi/cam. Default: all ETSI ITS messages."""
    stamp: Expression | None = None
    """CEL over msg: the sender's time in seconds since the epoch, e.g. msg.time_ms / 1000; or sample.received, the
    receive time (in a JSON-lines recording, the field t). Default: header.stamp if the type has one, the generation
    time of an ETSI ITS message, otherwise none."""
    position: StreamPosition | None = None
    """The position of the client in a sample. Expressions over a sample use it as position, and pairs scopes can refer
    to it."""
    stale_after: Duration | str | None = Field(
        default=None,
        json_schema_extra={
            "type": "string",
            "pattern": f"^({PositiveDuration.pattern}|Never)$",
            "maxLength": PositiveDuration.maximum_length,
            "x-kubernetes-validations": list(PositiveDuration.rules),
        },
    )
    """The signals of the stream are unknown if its newest sample is older than this. Never: no limit, for latched
    topics. Default: 5s, or clientTimeout if that is shorter; Never for latched streams."""
    buffer: StreamBuffer = StreamBuffer()
    """The limits of the stream's buffer, per client. Default: the limits of the Detector's buffer."""

    latched: bool = False
    """If true, the last sample of each key stays valid until replaced, e.g. /tf_static or a map. It is kept beyond the
    buffer's duration, staleAfter defaults to Never, and a replay delivers it first."""
    frame_prefix: str | None = Field(default=None, min_length=1, max_length=128)
    """Only with type tf2_msgs/msg/TFMessage: a prefix to remove from the names of the frames, so that every client has
    the same frame names. ${client} stands for the client's name, e.g. ${client}/."""

    @model_validator(mode="after")
    def _coherent(self) -> Stream:
        if self.encoding is Encoding.CDR and self.type is None:
            raise ValueError("type is required with encoding cdr: add it, e.g. geometry_msgs/msg/PoseStamped")
        if self.encoding not in (Encoding.CDR, Encoding.UPER) and self.type is not None:
            raise ValueError(f"type is not allowed with encoding {self.encoding}: remove it")
        if self.layout is Layout.RMW_ZENOH and self.encoding not in (Encoding.CDR, Encoding.RAW):
            raise ValueError(
                f"layout RmwZenoh needs ROS 2 messages: encoding must be cdr or raw; got {self.encoding}: "
                "change encoding, or remove layout"
            )
        if self.layout is Layout.RMW_ZENOH and self.source != ZENOH:
            raise ValueError(f"layout RmwZenoh needs source zenoh; got {self.source}: remove layout or source")
        if self.domain is not None and self.layout is not Layout.RMW_ZENOH:
            raise ValueError("domain is valid only with layout RmwZenoh: remove it")
        if self.type is not None and (self.encoding is Encoding.UPER) != self.type.startswith("etsi/"):
            example = "etsi/cam" if self.encoding is Encoding.UPER else "geometry_msgs/msg/PoseStamped"
            raise ValueError(
                f"type must be a message type of {self.encoding} streams, such as {example}; got {self.type}"
            )
        captures = "${client:" in self.key
        if captures and self.client is not None:
            raise ValueError("key captures the client, and client names one: remove the capture or client")
        if not captures and self.client is None:
            raise ValueError("key does not capture the client: write ${client:*} in place of its name, or set client")
        if self.items is not None:
            self._check_items()
        if self.frame_prefix is not None and not self.carries_transforms:
            raise ValueError("framePrefix is valid only for streams of type tf2_msgs/msg/TFMessage: remove it")
        if self.stale_after is not None and self.stale_after != "Never":
            try:
                PositiveDuration.parse(self.stale_after)
            except ValueError as error:
                raise ValueError(f"staleAfter: {error}, or write Never") from None
        return self

    def _check_items(self) -> None:
        if not self.names_by_message:
            raise ValueError("items needs client, a template that names the client of each item, e.g. ${item.id}")
        if self.latched or self.carries_transforms:
            what = "latched streams" if self.latched else "transforms"
            raise ValueError(f"items is not valid for {what}: remove items{' or latched' if self.latched else ''}")

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
        """Whether the newest sample never becomes stale."""
        return self.stale_after == "Never" or (self.latched and self.stale_after is None)

    @property
    def carries_transforms(self) -> bool:
        """Whether its samples feed the transform trees of their clients."""
        return self.type == TRANSFORMS
