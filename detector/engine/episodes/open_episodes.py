"""Open episodes in the form that survives a restart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from detector.engine.episodes.plain import plain
from detector.engine.episodes.record import EpisodeRecord
from detector.engine.episodes.subjects import Subject
from wayside.names import parse_subject
from wayside.times import format_time, parse_time


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
