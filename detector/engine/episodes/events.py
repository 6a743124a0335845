"""Events: the messages that an episode started or ended, as CloudEvents 1.0."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec

from detector.engine.episodes.episodes import EndReason
from detector.engine.episodes.plain import plain_text, quote, to_text
from detector.engine.episodes.record import EpisodeRecord
from detector.engine.episodes.rendering import Rendered
from wayside.api.base import JsonValue
from wayside.times import format_time

STARTED = "dev.wayside.event.started"
ENDED = "dev.wayside.event.ended"


class Event(msgspec.Struct, frozen=True, gc=False):
    """The start of an episode, or its end if there is a reason. Times are nanoseconds since the epoch."""

    holder: str
    episode: EpisodeRecord
    values: Mapping[str, JsonValue]
    """The rule's variables at the start or at the end; unknown ones are left out."""
    end_time: int | None = None
    reason: EndReason | None = None
    models: Mapping[str, str] = msgspec.field(default_factory=dict)
    """By signal, the sha256 of the model that computes it."""
    dry_run: bool = False
    """No action of the rule runs."""

    rendered: Mapping[str, Rendered] = msgspec.field(default_factory=dict)
    """The texts rendered for the actions, by their names: at the start; at the end those that read statistics of the
    episode. Not published."""

    traceparent: str | None = None
    """The trace context of the episode; None if traces are off. The engine does not set it."""

    recording: str | None = None
    """The recording that it comes from, if several were replayed. The engine does not set it."""

    @property
    def started(self) -> bool:
        """Whether the episode started; otherwise it ended."""
        return self.reason is None

    @property
    def time(self) -> int:
        """When the episode started or ended."""
        return self.episode.start_time if self.end_time is None else self.end_time

    @property
    def key(self) -> str:
        """The Zenoh key on which the event is published."""
        return f"wayside/events/{self.holder}/{self.episode.rule}/{self.episode.subject}"

    def cloud_event(self) -> dict[str, Any]:
        """The event as a CloudEvent in JSON."""
        event: dict[str, Any] = json.loads(self.to_json())
        return event

    def to_json(self) -> str:
        """The CloudEvent on one line; the same event always gives the same bytes.

        Raises:
            ValueError: a time is outside the years 1 to 9999.
            TypeError: a value has no form in JSON.
        """
        # The text is built by hand: an encoder takes several times as long.
        known = self.episode
        kind, what = (STARTED, "started") if self.reason is None else (ENDED, "ended")
        rule, episode, start = quote(known.rule), quote(known.id), format_time(known.start_time)
        onset = start if known.onset_time == known.start_time else format_time(known.onset_time)
        time = start if self.end_time is None else format_time(self.end_time)
        trace = "" if self.traceparent is None else f',"traceparent":{quote(self.traceparent)}'
        recording = "" if self.recording is None else f',"recording":{quote(self.recording)}'
        element = "" if known.element is None else f',"element":{quote(known.element)}'
        reason = "" if self.end_time is None or self.reason is None else f',"endTime":"{time}","reason":"{self.reason}"'
        models = f',"models":{to_text(dict(self.models))}' if self.models else ""
        classification = "" if known.classification is None else f',"classification":{_text_once(known.classification)}'
        dry_run = ',"dryRun":true' if self.dry_run else ""
        return (
            f'{{"specversion":"1.0","id":{episode[:-1]}.{what}","source":{quote(f"/detectors/{self.holder}")}'
            f',"type":"{kind}","subject":{quote(known.subject)},"time":"{time}","datacontenttype":"application/json"'
            f'{trace}{recording},"data":{{"rule":{rule},"episode":{episode}'
            f',"subjects":[{",".join(map(quote, known.clients))}]{element}'
            f',"onsetTime":"{onset}","startTime":"{start}"{reason}'
            f',"values":{plain_text(self.values)}{models}{classification}{dry_run}}}}}'
        )


_MAXIMUM_TEXTS = 1000
_texts: dict[int, tuple[Mapping[str, JsonValue], str]] = {}
"""By id, mappings that never change, and their texts. They are kept, so that no other object gets their id."""


def _text_once(constant: Mapping[str, JsonValue]) -> str:
    """The same as `to_text` of a mapping that never changes; rules share theirs with all their events. Thread-safe."""
    found = _texts.get(id(constant))
    if found is None:
        if len(_texts) >= _MAXIMUM_TEXTS:
            _texts.clear()
        found = _texts[id(constant)] = constant, to_text(dict(constant))
    return found[1]


class OrderedEvent(NamedTuple):
    """An event, and its position in the order of all."""

    time: int
    order: int
    """The rule's place among the rules."""
    event: Event
