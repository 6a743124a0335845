"""The description of a recording: its name, the records about its episode, and rosbag2's metadata.yaml. Pure.

metadata.yaml makes a folder of MCAP files a bag. It lists only ROS topics: rosbag2 and similar tools reject a bag with
other topics, and skip topics in the files that are not listed. Every ROS 2 since Humble reads version 8.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from detector.actions.episode import Episode
from detector.actions.record.channels import qos
from detector.actions.record.mcap_file import Contents
from wayside.api.base import JsonValue
from wayside.names import encode
from wayside.times import format_time

FORMAT = "wayside recording 1"
"""The value of `format` in the description, which identifies a recording. The number is the version."""
DESCRIPTION = "recording.json"
"""The name of the description's file, in the recording's folder."""
METADATA = "wayside"
"""The MCAP metadata record about the episode, at the start of each file."""
METADATA_END = "wayside/end"
"""The metadata record about its end, at the end of each file."""
METADATA_CUT = "cut"
"""The metadata record with the reason why the file is incomplete."""
METADATA_USER = "metadata"
"""The metadata record with the rule's `metadata`."""

_SUBJECT = 60
"""Maximum length of a subject in names, which have 255 characters at most; longer ones are shortened. The id of the
episode distinguishes them.
"""


@dataclass(frozen=True)
class Description:
    """An episode, and its recorder."""

    holder: str
    detector: str
    rule: str
    generation: int
    """The generation of the EventRule; 0 if it comes from a file."""
    action: str
    episode: Episode
    continued: bool = False
    """The episode was recorded before."""

    part: int = 0
    """The number of the recording, from 1, if the episode has several."""

    @property
    def name(self) -> str:
        """The name of the folder, without the suffix for how it ended."""
        start = re.sub("[:.]", "-", format_time(self.episode.start_time)[:23]) + "Z"
        parts = [start, self.rule, self.episode.subject[:_SUBJECT], self.action, encode(self.episode.id)[:16]]
        if self.episode.resumed:
            parts.append("continued")
        if self.part:
            parts.append(f"part{self.part:04}")
        return "_".join(parts)

    def fields(self) -> dict[str, Any]:
        """All fields, for the description's file and the metadata."""
        episode = self.episode
        fields: dict[str, Any] = {
            "format": FORMAT,
            "holder": self.holder,
            "detector": self.detector,
            "rule": self.rule,
            "generation": self.generation,
            "action": self.action,
            "episode": episode.id,
            "subject": episode.subject,
            "subjects": list(episode.clients),
            "element": episode.element,
            "onsetTime": format_time(episode.onset_time),
            "startTime": format_time(episode.start_time),
            "endTime": None if episode.end_time is None else format_time(episode.end_time),
            "reason": episode.reason,
            "classification": None if episode.classification is None else dict(episode.classification),
            "values": dict(episode.values),
            "metadata": dict(episode.rendered) or None,
            "unrendered": dict(episode.unrendered) or None,
            "continued": self.continued or None,
            "part": self.part or None,
        }
        return {name: value for name, value in fields.items() if value is not None}


def with_ending(fields: Mapping[str, Any], **changes: JsonValue) -> dict[str, Any]:
    """The same with other values; None removes a field."""
    return {name: value for name, value in {**fields, **changes}.items() if value is not None}


_BEGINNING = (
    *("format", "holder", "detector", "rule", "generation", "action", "episode", "subject", "subjects", "element"),
    *("onsetTime", "startTime", "classification", "values", "continued", "part"),
)


def beginning(fields: Mapping[str, Any]) -> dict[str, str]:
    """The fields known at the start of a file, as MCAP metadata: text, or JSON for structured values."""
    return as_text({name: value for name, value in fields.items() if name in _BEGINNING})


def ending(fields: Mapping[str, Any]) -> dict[str, str]:
    """The fields known at the end."""
    names = ("rule", "episode", "endTime", "reason", "samples", "missing", "cut", "continues")
    return as_text({name: fields[name] for name in names if name in fields})


def as_text(values: Mapping[str, JsonValue]) -> dict[str, str]:
    """Values as text for metadata."""
    return {
        name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for name, value in values.items()
    }


_VERSION = 8


@dataclass(frozen=True, slots=True)
class BagFile:
    """One file of a bag."""

    name: str
    contents: Contents


def metadata_yaml(parts: Sequence[BagFile], custom: Mapping[str, str]) -> str:
    """The text of metadata.yaml. `custom` is additional metadata of the bag."""
    topics: dict[tuple[str, str], dict[str, Any]] = {}
    for part in parts:
        for name, type_name, digest, latched, count in _topics(part.contents):
            topic = topics.setdefault(
                (name, type_name),
                {
                    "topic_metadata": {
                        "name": name,
                        "type": type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": yaml.safe_dump(qos(latched)).strip(),
                        "type_description_hash": digest,
                    },
                    "message_count": 0,
                },
            )
            topic["message_count"] += count
    spans = [part.contents.span for part in parts if part.contents.chunks]
    start, end = min((first for first, _ in spans), default=0), max((last for _, last in spans), default=0)
    information = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(topic["message_count"] for topic in topics.values()),
        "topics_with_message_count": list(topics.values()),
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [part.name for part in parts],
        "files": [_file(part) for part in parts],
        "custom_data": dict(custom),
        "ros_distro": "",
    }
    return yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False, allow_unicode=True)


def _file(part: BagFile) -> dict[str, Any]:
    first, last = part.contents.span
    return {
        "path": part.name,
        "starting_time": {"nanoseconds_since_epoch": first},
        "duration": {"nanoseconds": last - first},
        "message_count": sum(count for *_, count in _topics(part.contents)),
    }


def _topics(contents: Contents) -> Iterable[tuple[str, str, str, bool, int]]:
    """For each ROS topic in a file: its name, type and hash, whether it is latched, and its number of messages."""
    counts = contents.by_channel
    for number, channel in contents.channels.items():
        if "offered_qos_profiles" in channel.metadata:
            yield (
                channel.topic,
                contents.schemas[channel.schema_id].name,
                channel.metadata["topic_type_hash"],
                channel.metadata.get("latched") == "true",
                counts.get(number, 0),
            )
