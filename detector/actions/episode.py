"""What an action receives of an episode: its events, its rendered values, and its samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from detector.engine.consequences.excerpts import EpisodeSample
from wayside.api.base import JsonValue

__all__ = ["Completion", "Episode", "EpisodeSample", "Outcome", "OutcomeState"]


@dataclass(frozen=True)
class Episode:
    """One occurrence of a rule's event, for one subject. Times are nanoseconds since the epoch."""

    id: str
    rule: str
    subject: str
    """As in events: `car1`, `car1+car2`, `~fleet`, followed by `~` and the element of `each` where there is one."""
    clients: tuple[str, ...]
    """The clients that it is about."""
    element: str | None
    onset_time: int
    start_time: int
    values: Mapping[str, JsonValue]
    """The rule's variables at the start; what is unknown is left out."""
    classification: Mapping[str, JsonValue] | None
    rendered: Mapping[str, JsonValue]
    """The action's templates, rendered at the start, or see `rendered_again`; what could not be rendered is missing."""
    unrendered: Mapping[str, str]
    """Of the action's templates, those that could not be rendered, and why."""
    started: Mapping[str, Any]
    """The CloudEvent of the start."""
    resumed: bool = False
    """It was open before the detector started: what there was of it then, another run of the action has seen."""
    end_time: int | None = None
    """None while it is open."""
    reason: str | None = None
    """Why it ended: Until, OutOfScope, Unknown, ClientLost or RuleChanged."""
    ended: Mapping[str, Any] | None = None
    """The CloudEvent of the end."""
    rendered_again: bool = False
    """It has ended, and templates that read statistics of the episode were rendered again."""


@dataclass(frozen=True, slots=True)
class Completion:
    """The last of an episode: its event has ended, and its window as well."""

    cut: str = ""
    """Why the window ended before its time, e.g. since the detector stops; empty where it did not."""
    missing: int = 0
    """Samples of the window that the action was too slow to take."""


class OutcomeState(StrEnum):
    """How far an action has come with an episode."""

    RUNNING = "Running"
    DONE = "Done"
    FAILED = "Failed"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an action reports about its work for one episode."""

    state: OutcomeState
    message: str = ""
    """Why it failed, or what else there is to know."""
    samples: int = 0
    bytes: int = 0
    missing: int = 0
    """Samples, messages or the like that were lost on the way."""
    files: tuple[str, ...] = ()
    details: Mapping[str, JsonValue] = field(default_factory=dict)
    """More about it, in camelCase."""
