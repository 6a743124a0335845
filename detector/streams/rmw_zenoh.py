"""ROS 2 over Zenoh in the layout of rmw_zenoh (its docs/design.md): the key contains the type, an attachment the
sequence number.

A key has the form `<domain>/<topic>/<type>/<type hash>`, with the type in DDS notation:
`0/car1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_…`. Only the topic is passed on, so the same Detector reads a
recording of topics, and the intake records what its replay needs.

The attachment has the sequence number and source timestamp (8 bytes each, little endian), then the publisher's id (its
length in one byte, then 16 bytes); earlier versions wrote the field's name with its length before each. The source
timestamp is not used: a recording of topics does not have it, and would give other events.

A publisher counts its samples one by one. The first sample gives the current number; a later step of more than one
gives the number of losses. A lower number is a late sample; a number far off means that the publisher restarted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import zenoh

from detector.engine.samples.intake import Put
from detector.streams.loss_counter import Cause, LossCounter

MAXIMUM_PUBLISHERS = 10_000
"""Maximum number of tracked publishers of a stream; beyond it, the oldest one is forgotten."""

_RESTARTED = 2**32
"""A step of this size is no loss, but a restart: no publisher sends that many samples unnoticed."""

_BACK = 1000
"""A number this far back is no late sample."""


class Sequences:
    """Tracks the sequence numbers of a stream's publishers; only for the thread that receives the stream."""

    __slots__ = ("_last", "_loss_counter", "_stream")

    def __init__(self, stream: str, loss_counter: LossCounter) -> None:
        self._stream = stream
        self._loss_counter = loss_counter
        self._last: dict[bytes, int] = {}

    def follow(self, publisher: bytes, number: int, topic: str) -> None:
        """A sample with this number arrived from the publisher."""
        last = self._last.get(publisher)
        if last is not None and number == last + 1:
            self._last[publisher] = number
            return
        if last is None:
            if len(self._last) >= MAXIMUM_PUBLISHERS:
                del self._last[next(iter(self._last))]
            self._last[publisher] = number
        elif last < number < last + _RESTARTED:
            self._last[publisher] = number
            which = str(last + 1) if number == last + 2 else f"{last + 1} to {number - 1}"
            missed = f"{topic}: {which} of publisher {publisher.hex()}"
            self._loss_counter.add(Cause.MISSED, self._stream, number - last - 1, missed)
        elif last - _BACK < number <= last:
            if number < last:
                self._loss_counter.add(Cause.OVERTAKEN, self._stream, last=topic)
        else:
            self._last[publisher] = number


_TOPICS = 200_000
"""Maximum number of cached keys of a stream; beyond it, they are parsed again."""

_GID = 16
_NAMED = b"\x0fsequence_number"
_NAMED_GID = b"\x0asource_gid\x10"


class KeyMismatchError(ValueError):
    """A key does not belong to the stream; the message gives the reason."""


def topics_expression(topics: str, domain: int | None) -> str:
    """The key expression for topics, given as a key expression; `domain` None: of every domain."""
    return f"{'*' if domain is None else domain}/{topics}/*/*"


def split(key: str) -> tuple[str, str]:
    """Topic and type, e.g. car1/odom and nav_msgs/msg/Odometry. Raises KeyMismatchError."""
    domain, _, rest = key.partition("/")
    parts = rest.rsplit("/", 2)
    if len(parts) < 3 or not domain.isdecimal():
        raise KeyMismatchError(f"{key} is not of the form <domain>/<topic>/<type>/<type hash>")
    topic, mangled, _ = parts
    names = mangled.replace("%", "/").replace("::", "/").split("/")
    if len(names) == 4 and names[2] == "dds_" and names[3].endswith("_"):
        names = [*names[:2], names[3][:-1]]
    if len(names) != 3 or not all(names):
        raise KeyMismatchError(f"{key} contains no type: {mangled} is not of the form <package>::msg::dds_::<Type>_")
    return topic, "/".join(names)


def numbered(attachment: bytes) -> tuple[bytes, int] | None:
    """The publisher and the number of its sample; None if the attachment has neither form."""
    if len(attachment) == 17 + _GID and attachment[16] == _GID:
        return attachment[17:], int.from_bytes(attachment[:8], "little", signed=True)
    if attachment.startswith(_NAMED) and attachment[-_GID - len(_NAMED_GID) : -_GID] == _NAMED_GID:
        start = len(_NAMED)
        return attachment[-_GID:], int.from_bytes(attachment[start : start + 8], "little", signed=True)
    return None


class RmwReader:
    """Reads keys and attachments of one stream; only for the thread that receives it."""

    def __init__(self, stream: str, type_name: str | None, loss_counter: LossCounter) -> None:
        """`type_name`: the type that the keys must have, None for any."""
        self._stream = stream
        self._type = type_name
        self._loss_counter = loss_counter
        self._sequences = Sequences(stream, loss_counter)
        self._topics: dict[str, str] = {}

    def topic(self, key: str) -> str | None:
        """The topic of a key; None, and counted, for a key of another type or layout."""
        topic = self._topics.get(key)
        if topic is None:
            try:
                topic, given = split(key)
            except KeyMismatchError as error:
                self._loss_counter.add(Cause.MISFIT, self._stream, last=str(error))
                return None
            if self._type not in (None, given):
                misfit = f"{topic} is of type {given}, but the type of the stream is {self._type}"
                self._loss_counter.add(Cause.MISFIT, self._stream, last=misfit)
                return None
            if len(self._topics) >= _TOPICS:
                self._topics.clear()
            self._topics[key] = topic
        return topic

    def follow(self, topic: str, attachment: bytes | None) -> None:
        """Track the attachment of a sample on the topic."""
        given = None if attachment is None else numbered(attachment)
        if given is None:
            self._loss_counter.add(Cause.UNNUMBERED, self._stream, last=topic)
        else:
            self._sequences.follow(*given, topic)


def pump_by_topic(bursts: Iterable[Sequence[zenoh.Sample]], put: Put, reader: RmwReader) -> None:
    """Delivers every message by its topic, as `subscribing.pump_by_key` does by its key."""
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
