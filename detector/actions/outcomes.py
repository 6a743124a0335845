"""The outcomes of actions: kept by action for the status, and published as progress events on Zenoh.

    wayside/actions/<holder>/<rule>/<episode>/<action>

A progress event is a CloudEvent, like an event: dev.wayside.action.running, .done or .failed.
"""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from detector.actions.episode import Episode, Outcome, OutcomeState
from detector.engine.episodes.plain import plain
from wayside.times import format_time

ENCODING = "application/cloudevents+json"
_MESSAGE_LIMIT = 2000
_FILES_LIMIT = 100


class ActionKey(NamedTuple):
    """An action of a rule."""

    rule: str
    action: str


@dataclass(slots=True)
class ActionCounts:
    """The counts of an action since the detector's start, or since its kind last changed."""

    kind: str
    running: int = 0
    done: int = 0
    failed: int = 0
    samples: int = 0
    """Of runs that are done or failed, like bytes, missing and files."""
    bytes: int = 0
    missing: int = 0
    files: int = 0
    last_failure: str = ""
    last_file: str = ""
    current: dict[str, str] = field(default_factory=dict)
    """By running episode, the last message, if any."""


@dataclass(frozen=True, slots=True)
class _Lost:
    """The losses of an action, of one kind."""

    which: ActionKey
    what: str
    count: int
    last: str


class Outcomes:
    """Keeps and publishes outcomes; thread-safe."""

    def __init__(self, holder: str, publish: Callable[[str, bytes, str], None], now: Callable[[], int]) -> None:
        """`publish` takes key, payload and encoding and never waits; `now` returns nanoseconds since the epoch."""
        self._holder = holder
        self._publish = publish
        self._now = now
        self._lock = threading.Lock()
        self._counts: dict[ActionKey, ActionCounts] = {}
        self._reported: dict[tuple[ActionKey, str], Outcome | None] = {}
        """The runs that are neither done nor failed, with their last outcome."""
        self._lost: Counter[tuple[ActionKey, str]] = Counter()
        self._reasons: dict[tuple[ActionKey, str], str] = {}
        self.on_outcome: Callable[[ActionKey, str, Outcome], None] = lambda which, episode, outcome: None
        """Called with each new outcome and the id of the episode, on the thread that reports it."""

    def register(self, which: ActionKey, kind: str) -> None:
        """Register the action, whether or not it ever runs."""
        with self._lock:
            if which not in self._counts or self._counts[which].kind != kind:
                self._counts[which] = ActionCounts(kind)

    def begin(self, which: ActionKey, episode: Episode) -> None:
        """The action starts with the episode."""
        with self._lock:
            if (which, episode.id) not in self._reported:
                self._reported[which, episode.id] = None
                self._counts[which].running += 1

    def report(self, which: ActionKey, episode: Episode, outcome: Outcome) -> None:
        """See `ActionContext.report`. Reports after DONE or FAILED and repeated reports are ignored."""
        with self._lock:
            known = (which, episode.id)
            if known not in self._reported or self._reported[known] == outcome:
                return
            counts = self._counts[which]
            if outcome.state is OutcomeState.RUNNING:
                self._reported[known] = outcome
                counts.current[episode.id] = outcome.message
            else:
                del self._reported[known]
                counts.current.pop(episode.id, None)
                _count(counts, outcome)
        self.on_outcome(which, episode.id, outcome)
        document = follow_up(self._holder, which, episode, outcome, self._now())
        key = f"wayside/actions/{self._holder}/{which.rule}/{episode.id}/{which.action}"
        self._publish(key, json.dumps(document, separators=(",", ":"), allow_nan=False).encode(), ENCODING)

    def is_open(self, which: ActionKey, episode: str) -> bool:
        """Whether the run is neither done nor failed."""
        with self._lock:
            return (which, episode) in self._reported

    def is_silent(self, which: ActionKey, episode: str) -> bool:
        """Whether nothing was reported about the run yet."""
        with self._lock:
            return (which, episode) in self._reported and self._reported[which, episode] is None

    def lose(self, which: ActionKey, what: str, count: int, last: str) -> None:
        """See `ActionContext.lose`."""
        with self._lock:
            self._lost[which, what] += count
            self._reasons[which, what] = last

    def counts_by_action(self) -> dict[ActionKey, ActionCounts]:
        """A copy of the counts of each action."""
        with self._lock:
            return {
                which: replace(counts, current=dict(counts.current)) for which, counts in sorted(self._counts.items())
            }

    def lost(self) -> list[_Lost]:
        """All losses."""
        with self._lock:
            return [
                _Lost(which, what, count, self._reasons[which, what])
                for (which, what), count in sorted(self._lost.items())
            ]


def follow_up(holder: str, which: ActionKey, episode: Episode, outcome: Outcome, now: int) -> dict[str, Any]:
    """The CloudEvent of an outcome; `now` is nanoseconds since the epoch."""
    data: dict[str, Any] = {
        "rule": which.rule,
        "action": which.action,
        "episode": episode.id,
        "subjects": list(episode.clients),
        "state": outcome.state.value,
        **_given("message", outcome.message[:_MESSAGE_LIMIT]),
        **_given("samples", outcome.samples),
        **_given("bytes", outcome.bytes),
        **_given("missing", outcome.missing),
        **_given("files", list(outcome.files[:_FILES_LIMIT])),
        **_given("details", plain(outcome.details)),
    }
    return {
        "specversion": "1.0",
        "id": f"{episode.id}.{which.action}.{now}",
        "source": f"/detectors/{holder}",
        "type": f"dev.wayside.action.{outcome.state.value.lower()}",
        "subject": episode.subject,
        "time": format_time(now),
        "datacontenttype": "application/json",
        "data": data,
    }


def _given(name: str, value: Any) -> Mapping[str, Any]:
    return {name: value} if value else {}


def _count(counts: ActionCounts, outcome: Outcome) -> None:
    counts.running -= 1
    counts.samples += outcome.samples
    counts.bytes += outcome.bytes
    counts.missing += outcome.missing
    counts.files += len(outcome.files)
    if outcome.files:
        counts.last_file = outcome.files[-1]
    if outcome.state is OutcomeState.DONE:
        counts.done += 1
    else:
        counts.failed += 1
        counts.last_failure = outcome.message
