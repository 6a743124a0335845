"""Open episodes in the form that survives a restart, and the demands they are restored from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from detector.engine.episodes.demands import Demand
from detector.engine.episodes.episodes import Ending
from detector.engine.episodes.events import Event
from detector.engine.episodes.plain import plain
from detector.engine.episodes.subjects import Subject
from wayside.api.base import JsonValue
from wayside.names import parse_subject
from wayside.times import format_time, parse_time


@dataclass(frozen=True, slots=True)
class OpenEpisode:
    """An episode that has not ended. Times are nanoseconds since the epoch."""

    rule: str
    subject: Subject
    episode: str
    """The id of the episode."""
    onset_time: int
    start_time: int
    values: Mapping[str, JsonValue]
    """The rule's values at the start."""
    classification: Mapping[str, JsonValue] | None
    rule_digest: str
    """Digest of the rule's semantics under which it started."""
    statistics: Mapping[str, Any] | None = None
    """The current statistics of its signals over the episode, see `Statistics.to_document`; None: it has none, or lost
    them."""

    def to_document(self) -> dict[str, Any]:
        """The episode as a JSON document."""
        return {
            "rule": self.rule,
            "subject": self.subject.text,
            "episode": self.episode,
            "onsetTime": format_time(self.onset_time),
            "startTime": format_time(self.start_time),
            "values": plain(self.values),
            **({} if self.classification is None else {"classification": dict(self.classification)}),
            "ruleDigest": self.rule_digest,
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
            raise ValueError(f"an episode's {field} must be a text, is {document.get(field)!r:.80}")
    values, classification = document.get("values"), document.get("classification")
    if not isinstance(values, dict) or not isinstance(classification, dict | None):
        raise ValueError("the values of an episode, and its classification, must be maps")
    statistics = document.get("statistics")
    if not isinstance(statistics, dict | None):
        raise ValueError("the statistics of an episode must be a map")
    return OpenEpisode(
        rule=document["rule"],
        subject=Subject(*parse_subject(document["subject"])),
        episode=document["episode"],
        onset_time=parse_time(document["onsetTime"]),
        start_time=parse_time(document["startTime"]),
        values=values,
        classification=classification,
        rule_digest=document["ruleDigest"],
        statistics=statistics,
    )


def episode_of(demand: Demand) -> OpenEpisode:
    """The episode of a demand. Without an element, the subject's text may differ from the demand's."""
    try:
        _, element = parse_subject(demand.subject)
    except ValueError:
        element = None
    return OpenEpisode(
        rule=demand.rule,
        subject=Subject(demand.subjects, element),
        episode=demand.episode,
        onset_time=demand.onset_time,
        start_time=demand.start_time,
        values=demand.values,
        classification=demand.classification,
        rule_digest=demand.rule_digest,
    )


def ended_while_away(episode: OpenEpisode, holder: str, now: int) -> Event:
    """The end of an episode whose rule changed or was removed while the detector was not running."""
    return Event(
        holder=holder,
        rule=episode.rule,
        subject=episode.subject.text,
        subjects=episode.subject.clients,
        episode=episode.episode,
        onset_time=episode.onset_time,
        start_time=episode.start_time,
        end_time=now,
        reason=Ending.RULE_CHANGED,
        values={},
        classification=episode.classification,
        element=episode.subject.element,
    )
