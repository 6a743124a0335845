"""Events: the messages that an episode started or ended, as CloudEvents 1.0."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from detector.engine.episodes.demands import plain
from detector.engine.episodes.episodes import Reason
from detector.engine.episodes.rendering import Rendered
from wayside.api.base import JsonValue
from wayside.times import format_time

STARTED = "dev.wayside.event.started"
ENDED = "dev.wayside.event.ended"


@dataclass(frozen=True, slots=True)
class Event:
    """An episode started, or ended where there is a reason. Times are nanoseconds since the epoch."""

    holder: str
    rule: str
    subject: str
    subjects: tuple[str, ...]
    episode: str
    onset_time: int
    start_time: int
    end_time: int | None
    reason: Reason | None
    values: Mapping[str, JsonValue]
    classification: Mapping[str, JsonValue] | None
    models: Mapping[str, str] = field(default_factory=dict)
    """The sha256 of the models that the rule's signals are computed by, by signal."""
    element: str | None = None
    """The element of `each` that the rule was evaluated for."""

    dry_run: bool = False
    """No action of the rule runs."""

    rendered: Mapping[str, Rendered] = field(default_factory=dict)
    """Of a start: what is rendered for the actions, by their names. It is for them alone."""

    traceparent: str | None = None
    """Where the episode stands in a trace; None where traces are off. The engine knows nothing of it."""

    recording: str | None = None
    """The recording that it is from, where several were replayed. The engine knows nothing of it."""

    @property
    def started(self) -> bool:
        """Whether the episode started; else it ended."""
        return self.reason is None

    @property
    def key(self) -> str:
        """The Zenoh key on which the event is published."""
        return f"wayside/events/{self.holder}/{self.rule}/{self.subject}"

    def cloud_event(self) -> dict[str, Any]:
        """The event as a CloudEvent in JSON."""
        time = self.start_time if self.end_time is None else self.end_time
        data: dict[str, Any] = {
            "rule": self.rule,
            "episode": self.episode,
            "subjects": list(self.subjects),
            **({} if self.element is None else {"element": self.element}),
            "onsetTime": format_time(self.onset_time),
            "startTime": format_time(self.start_time),
        }
        if self.end_time is not None and self.reason is not None:
            data["endTime"] = format_time(self.end_time)
            data["reason"] = self.reason.value
        data["values"] = plain(self.values)
        if self.models:
            data["models"] = dict(self.models)
        if self.classification is not None:
            data["classification"] = dict(self.classification)
        if self.dry_run:
            data["dryRun"] = True
        return {
            "specversion": "1.0",
            "id": f"{self.episode}.{'started' if self.started else 'ended'}",
            "source": f"/detectors/{self.holder}",
            "type": STARTED if self.started else ENDED,
            "subject": self.subject,
            "time": format_time(time),
            "datacontenttype": "application/json",
            **({} if self.traceparent is None else {"traceparent": self.traceparent}),
            **({} if self.recording is None else {"recording": self.recording}),
            "data": data,
        }

    def to_json(self) -> str:
        """The CloudEvent on one line; the same event always gives the same bytes."""
        return json.dumps(self.cloud_event(), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
