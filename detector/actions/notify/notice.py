"""A notification: one event of an episode, with the rule's texts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wayside.api.actions.notify import NotifiedEvent

GROUP_TYPE = "dev.wayside.event.group"
"""The type of a CloudEvent that combines several events."""


@dataclass(frozen=True, slots=True)
class NoticeTexts:
    """The texts of a rule about an episode."""

    title: str | None = None
    text: str | None = None
    labels: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As a JSON object for events and the journal; absent parts are left out."""
        given = {"title": self.title, "text": self.text, "labels": dict(self.labels) or None}
        return {name: value for name, value in given.items() if value is not None}


def texts(rendered: Mapping[str, Any]) -> NoticeTexts:
    """The texts from the rendered templates; other values are converted to text."""
    labels = rendered.get("labels")
    return NoticeTexts(
        _text(rendered.get("title")),
        _text(rendered.get("text")),
        {name: _text(value) or "" for name, value in labels.items()} if isinstance(labels, Mapping) else {},
    )


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return json.dumps(value, ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class Notice:
    """One event for a notification."""

    episode: str
    event: Mapping[str, Any]
    """The CloudEvent as published on Zenoh."""
    texts: NoticeTexts
    created: float
    """Seconds since the epoch."""

    @property
    def id(self) -> str:
        """The id of the event, which is the same for every attempt."""
        return str(self.event["id"])

    @property
    def moment(self) -> NotifiedEvent:
        """Whether an episode started or ended."""
        return NotifiedEvent.STARTED if str(self.event["type"]).endswith(".started") else NotifiedEvent.ENDED

    def to_json(self) -> dict[str, Any]:
        """As a JSON object for the journal."""
        return {
            "episode": self.episode,
            "event": dict(self.event),
            "texts": self.texts.to_json(),
            "created": self.created,
        }


def notice_from(document: Mapping[str, Any]) -> Notice:
    """The notification from what `to_json` returned. Raises KeyError, TypeError or ValueError for anything else."""
    event = document["event"]
    if not isinstance(event, dict) or not isinstance(event["data"], dict) or not isinstance(event["type"], str):
        raise ValueError("no event")
    return Notice(str(document["episode"]), event, texts(document["texts"]), float(document["created"]))


def event_of(notice: Notice) -> dict[str, Any]:
    """The CloudEvent of a single event: as published on Zenoh, with the rule's texts added to its data."""
    notification = notice.texts.to_json()
    data = {**notice.event["data"], **({"notification": notification} if notification else {})}
    return {**notice.event, "data": data}


def event_of_group(notices: Sequence[Notice], action: str, by: Sequence[str], maximum: int) -> dict[str, Any]:
    """One CloudEvent for several events of a rule, in order of their arrival.

    Its id is derived from theirs: the same events always have the same id. The texts are those of the first event;
    `labels` has the common labels of all events, which are the grouping labels.

    Args:
        notices: at least one.
        action: the action's name in the rule.
        by: the grouping labels.
        maximum: number of events given in full.
    """
    first, last = notices[0], notices[-1]
    ids = "\n".join(notice.id for notice in notices)
    more = len(notices) - 1
    labels = {name: first.texts.labels.get(name, "") for name in by}
    text = first.texts.text
    notification = NoticeTexts(
        first.texts.title, f"{text} (and {more} more)" if text and more else text, labels
    ).to_json()
    starts = sum(notice.moment is NotifiedEvent.STARTED for notice in notices)
    return {
        "specversion": "1.0",
        "id": f"group.{hashlib.sha256(ids.encode()).hexdigest()[:32]}",
        "source": first.event["source"],
        "type": GROUP_TYPE,
        "subject": f"{first.event['data']['rule']}/{action}",
        "time": last.event["time"],
        "datacontenttype": "application/json",
        "data": {
            "rule": first.event["data"]["rule"],
            "action": action,
            "count": len(notices),
            "started": starts,
            "ended": len(notices) - starts,
            "events": [event_of(notice) for notice in notices[:maximum]],
            "omitted": max(0, len(notices) - maximum),
            **({"notification": notification} if notification else {}),
        },
    }
