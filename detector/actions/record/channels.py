"""The channels of a recording: topic, encoding, schema, and ROS metadata of each stream.

Only ROS 2 messages have schemas. JSON, CBOR, ETSI ITS and raw messages have none (MCAP's schema 0); their encoding
determines their format.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from detector.actions.record.mcap_file import McapFile
from detector.streams.codecs.ros import RosTypes
from wayside.api.stream import Encoding, Stream
from wayside.keys import KeyPattern

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
"""rosbag2's form of an unlimited duration."""
_MAXIMUM_CHANNELS = 60_000
"""MCAP numbers channels with 16 bits: samples on further keys are left out, and counted as missing."""

Place = tuple[str, str, str]
"""A stream, a key and a client: each combination has a separate channel."""

_HISTORY = 100
"""Maximum number of publishers of a latched topic: the last message of each is republished on playback."""


@dataclass(frozen=True, slots=True)
class ChannelFormat:
    """The format of a stream's messages. When it changes, the stream continues in another channel."""

    encoding: str
    """MCAP's name of the encoding."""
    type: str | None
    """The ROS 2 message type."""
    definition: str | None
    """The definition of the type, including all types that it refers to."""
    digest: str
    """The ROS 2 hash of the type."""
    latched: bool

    @property
    def metadata(self) -> Mapping[str, str]:
        """rosbag2's metadata of a topic; empty if it is not a ROS topic."""
        if self.type is None:
            return {}
        return {"offered_qos_profiles": yaml.safe_dump(qos(self.latched)).strip(), "topic_type_hash": self.digest}


def channel_format(stream: Stream, types: RosTypes) -> ChannelFormat:
    """The format of the stream's messages."""
    if stream.encoding is not Encoding.CDR or stream.type is None or not types.known(stream.type):
        return ChannelFormat(stream.encoding.value, None, None, "", stream.latched)
    digest = types.store.hash_rihs01(stream.type)
    return ChannelFormat("cdr", stream.type, types.definition(stream.type), digest, stream.latched)


def qos(latched: bool) -> list[dict[str, Any]]:
    """The quality of service for rosbag2 to play a topic with, in the notation that every ROS 2 reads."""
    return [
        {
            "history": 1,  # keep last
            "depth": _HISTORY if latched else 10,
            "reliability": 1,  # reliable
            "durability": 1 if latched else 2,  # transient local, volatile
            "deadline": dict(_FOREVER),
            "lifespan": dict(_FOREVER),
            "liveliness": 1,  # automatic
            "liveliness_lease_duration": dict(_FOREVER),
            "avoid_ros_namespace_conventions": False,
        }
    ]


class FileChannels:
    """The channels of one file, created on first use."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._numbers: dict[Place, int] = {}
        self._schemas: dict[tuple[str, str], int] = {}

    def retain(self, streams: Collection[str]) -> None:
        """Samples of all streams except these go into new channels from now on."""
        self._numbers = {place: number for place, number in self._numbers.items() if place[0] in streams}

    def number(self, place: Place, known: ChannelFormat | None) -> int | None:
        """The number of a channel in the file; None if there are too many."""
        number = self._numbers.get(place)
        if number is None and len(self._file.contents.channels) < _MAXIMUM_CHANNELS:
            number = self._numbers[place] = self._new(place, known or ChannelFormat("raw", None, None, "", False))
        return number

    def _new(self, place: Place, known: ChannelFormat) -> int:
        stream, key, client = place
        schema = 0
        if known.type is not None and known.definition is not None:
            about = known.type, known.definition
            schema = self._schemas.get(about) or self._file.schema(known.type, "ros2msg", known.definition.encode())
            self._schemas[about] = schema
        metadata = {"client": client, "stream": stream, **({"latched": "true"} if known.latched else {})}
        return self._file.channel(f"/{key}", known.encoding, schema, {**metadata, **known.metadata})


class Owners:
    """For streams that share a key, decides whose samples are recorded: each message is received and written once."""

    def __init__(self, streams: Mapping[str, Stream]) -> None:
        """The streams of the window, in the Detector's order."""
        self._streams = [(stream, KeyPattern.parse(stream.key)) for stream in streams.values()]
        self._owners: dict[tuple[str, str], str] = {}

    def owns(self, stream: str, key: str) -> bool:
        """Whether samples on the key are recorded as the stream's."""
        owner = self._owners.get((stream, key))
        if owner is None:
            owner = self._owners[stream, key] = self._owner(stream, key)
        return owner == stream

    def _owner(self, name: str, key: str) -> str:
        """The first stream that can read the messages; otherwise the first."""
        mine = next((_origin(stream) for stream, _ in self._streams if stream.name == name), None)
        same = [stream for stream, pattern in self._streams if _origin(stream) == mine and pattern.match(key)]
        if mine is None or not same:
            return name
        return next((stream for stream in same if stream.encoding is not Encoding.RAW), same[0]).name


def _origin(stream: Stream) -> Hashable:
    """Streams of the same key receive the same messages if this is equal."""
    return stream.source, stream.layout, stream.domain, stream.client
