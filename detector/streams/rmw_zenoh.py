"""ROS 2 over Zenoh as rmw_zenoh lays it out (its docs/design.md): the key gives the type, an attachment the sequence
number.

A key reads `<domain>/<topic>/<type>/<type hash>`, the type as DDS writes it:
`0/car1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_…`. What goes on from here is the topic alone: so the same Detector
reads a recording of topics, and the intake records what its replay needs.

The attachment holds sequence number and source timestamp (8 bytes each, little endian), then the publisher's id (its
length in one byte, then 16 bytes); earlier versions wrote the field's name before each, with its length. The source
timestamp is not used: a recording of topics does not have it, and would give other events.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import zenoh

from detector.streams.bursts import Put
from detector.streams.sequences import Sequences
from detector.streams.tally import Cause, Tally

_TOPICS = 200_000
"""Maximum number of cached keys of a stream; beyond, they are parsed again."""

_GID = 16
_NAMED = b"\x0fsequence_number"
_NAMED_GID = b"\x0asource_gid\x10"


class MisfitError(ValueError):
    """A key that does not belong to the stream; the message gives the reason."""


def topics_expression(topics: str, domain: int | None) -> str:
    """The key expression for topics, given as one; `domain` None: of every domain."""
    return f"{'*' if domain is None else domain}/{topics}/*/*"


def split(key: str) -> tuple[str, str]:
    """Topic and type, e.g. car1/odom and nav_msgs/msg/Odometry. Raises MisfitError."""
    domain, _, rest = key.partition("/")
    parts = rest.rsplit("/", 2)
    if len(parts) < 3 or not domain.isdecimal():
        raise MisfitError(f"{key} is not of the form <domain>/<topic>/<type>/<type hash>")
    topic, mangled, _ = parts
    names = mangled.replace("%", "/").replace("::", "/").split("/")
    if len(names) == 4 and names[2] == "dds_" and names[3].endswith("_"):
        names = [*names[:2], names[3][:-1]]
    if len(names) != 3 or not all(names):
        raise MisfitError(f"{key} names no type: {mangled} is not of the form <package>::msg::dds_::<Type>_")
    return topic, "/".join(names)


def numbered(attachment: bytes) -> tuple[bytes, int] | None:
    """The publisher and the number of its sample; None where the attachment is of neither form."""
    if len(attachment) == 17 + _GID and attachment[16] == _GID:
        return attachment[17:], int.from_bytes(attachment[:8], "little", signed=True)
    if attachment.startswith(_NAMED) and attachment[-_GID - len(_NAMED_GID) : -_GID] == _NAMED_GID:
        start = len(_NAMED)
        return attachment[-_GID:], int.from_bytes(attachment[start : start + 8], "little", signed=True)
    return None


class RmwReader:
    """Reads keys and attachments of one stream; for the one thread that receives it."""

    def __init__(self, stream: str, type_name: str | None, tally: Tally) -> None:
        """`type_name`: the type that the keys must give, None for any."""
        self._stream = stream
        self._type = type_name
        self._tally = tally
        self._sequences = Sequences(stream, tally)
        self._topics: dict[str, str] = {}

    def topic(self, key: str) -> str | None:
        """The topic of a key; None, and counted, for one of another type or layout."""
        topic = self._topics.get(key)
        if topic is None:
            try:
                topic, given = split(key)
            except MisfitError as error:
                self._tally.add(Cause.MISFIT, self._stream, last=str(error))
                return None
            if self._type not in (None, given):
                misfit = f"{topic} is of type {given}, but the type of the stream is {self._type}"
                self._tally.add(Cause.MISFIT, self._stream, last=misfit)
                return None
            if len(self._topics) >= _TOPICS:
                self._topics.clear()
            self._topics[key] = topic
        return topic

    def follow(self, topic: str, attachment: bytes | None) -> None:
        """A sample came on the topic with this attachment."""
        given = None if attachment is None else numbered(attachment)
        if given is None:
            self._tally.add(Cause.UNNUMBERED, self._stream, last=topic)
        else:
            self._sequences.follow(*given, topic)


def pump(bursts: Iterable[Sequence[zenoh.Sample]], put: Put, reader: RmwReader) -> None:
    """Hands over every message by its topic, as `plain.pump` does by its key."""
    put_kind = zenoh.SampleKind.PUT
    for burst in bursts:
        messages = []
        for sample in burst:
            topic = reader.topic(str(sample.key_expr)) if sample.kind == put_kind else None
            if topic is not None:
                messages.append((topic, sample.payload.to_bytes()))
                attachment = sample.attachment
                reader.follow(topic, None if attachment is None else attachment.to_bytes())
        put(messages)
