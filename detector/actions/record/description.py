"""The description of a recording: its name, and the records about its episode. Pure."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from detector.actions.episode import Episode
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
