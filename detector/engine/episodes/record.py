"""The data about an episode known from its start on, its identifier, and the form that survives a restart.

Events, demands and actions share the record.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from detector.engine.episodes.plain import plain
from detector.engine.episodes.subjects import Subject
from wayside.api.base import JsonValue
from wayside.names import parse_subject
from wayside.times import format_time, parse_time


class EpisodeRecord(msgspec.Struct, frozen=True, gc=False):
    """One occurrence of a rule's event, for one subject. Times are nanoseconds since the epoch."""

    id: str
    rule: str
    subject: str
    """The text in events: `car1`, `car1+car2`, `~fleet`, followed by `~` and the element of `each` if there is one."""
    clients: tuple[str, ...]
    """The clients of the subject."""
    element: str | None
    onset_time: int
    start_time: int
    values: Mapping[str, JsonValue]
    """The rule's variables at the start; unknown ones are left out."""
    classification: Mapping[str, JsonValue] | None
    rule_digest: str = ""
    """Digest of the rule's semantics under which it started."""

    @property
    def about(self) -> Subject:
        """The subject as clients and element."""
        return Subject(self.clients, self.element)


_LETTERS = "abcdefghijklmnopqrstuvwxyz234567"
_PAIRS = [first + second for first in _LETTERS for second in _LETTERS]
_TEN_BITS = 0x3FF


def identifier(data: bytes) -> str:
    """The first 80 bits of the SHA-256 of the data, in lowercase base32: 16 letters and digits."""
    # base64.b32encode and .lower() take twice as long, and each episode needs an identifier.
    digest, pairs = hashlib.sha256(data).digest(), _PAIRS
    head, tail = int.from_bytes(digest[:5], "big"), int.from_bytes(digest[5:10], "big")
    return (
        f"{pairs[head >> 30]}{pairs[head >> 20 & _TEN_BITS]}{pairs[head >> 10 & _TEN_BITS]}{pairs[head & _TEN_BITS]}"
        f"{pairs[tail >> 30]}{pairs[tail >> 20 & _TEN_BITS]}{pairs[tail >> 10 & _TEN_BITS]}{pairs[tail & _TEN_BITS]}"
    )


def episode_id(holder: str, rule: str, subject: str, start: int) -> str:
    """The identifier of the episode that starts at this time, in nanoseconds since the epoch."""
    return identifier(f"{holder}\0{rule}\0{subject}\0{start}".encode())


@dataclass(frozen=True, slots=True)
class OpenEpisode:
    """An episode that has not ended, as it survives a restart."""

    record: EpisodeRecord
    statistics: Mapping[str, Any] | None = None
    """The current statistics of its signals over the episode, see `Statistics.to_document`; None: it has none, or lost
    them."""

    def to_document(self) -> dict[str, Any]:
        """The episode as a JSON document."""
        record = self.record
        return {
            "rule": record.rule,
            "subject": record.subject,
            "episode": record.id,
            "onsetTime": format_time(record.onset_time),
            "startTime": format_time(record.start_time),
            "values": plain(record.values),
            **({} if record.classification is None else {"classification": dict(record.classification)}),
            "ruleDigest": record.rule_digest,
            **({} if self.statistics is None else {"statistics": self.statistics}),
        }


def from_document(document: Mapping[str, Any]) -> OpenEpisode:
    """The episode from a document that `to_document` made.

    Raises:
        ValueError: the document does not describe an episode; the text names the wrong field.
    """
    texts = ("rule", "subject", "episode", "onsetTime", "startTime", "ruleDigest")
    for field in texts:
        if not isinstance(document.get(field), str):
            raise ValueError(f"an episode's {field} must be a string; got {document.get(field)!r:.80}")
    values, classification = document.get("values"), document.get("classification")
    if not isinstance(values, dict) or not isinstance(classification, dict | None):
        raise ValueError("the values of an episode, and its classification, must be maps")
    statistics = document.get("statistics")
    if not isinstance(statistics, dict | None):
        raise ValueError("the statistics of an episode must be a map")
    subject = Subject(*parse_subject(document["subject"]))
    record = EpisodeRecord(
        id=document["episode"],
        rule=document["rule"],
        subject=subject.text,
        clients=subject.clients,
        element=subject.element,
        onset_time=parse_time(document["onsetTime"]),
        start_time=parse_time(document["startTime"]),
        values=values,
        classification=classification,
        rule_digest=document["ruleDigest"],
    )
    return OpenEpisode(record, statistics)
