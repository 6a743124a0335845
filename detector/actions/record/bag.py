"""rosbag2's metadata.yaml, which makes a folder of MCAP files a bag. Pure.

It lists only ROS topics: rosbag2 and similar tools reject a bag with other topics, and skip topics in the files that
are not listed. Every ROS 2 since Humble reads version 8.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from detector.actions.record.channels import qos
from detector.actions.record.mcap_contents import Contents

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
