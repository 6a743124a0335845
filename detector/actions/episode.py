"""The episode in the form that an action receives: its events, its rendered values, and its samples."""

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
    """The text in events: `car1`, `car1+car2`, `~fleet`, followed by `~` and the element of `each` if there is one."""
    clients: tuple[str, ...]
    """The clients of the subject."""
    element: str | None
    onset_time: int
    start_time: int
    values: Mapping[str, JsonValue]
    """The rule's variables at the start; unknown ones are left out."""
    classification: Mapping[str, JsonValue] | None
    rendered: Mapping[str, JsonValue]
    """The action's templates, rendered at the start, or see `rendered_again`; those that could not be rendered are
    missing."""
    unrendered: Mapping[str, str]
    """The action's templates that could not be rendered, each with the reason."""
    started: Mapping[str, Any]
    """The CloudEvent of the start."""
    resumed: bool = False
    """It was open before the detector started: its earlier part was handled by another run of the action."""
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
    """The end of an episode and of its window."""

    cut: str = ""
    """Why the window ended early, e.g. because the detector stops; empty if it did not."""
    missing: int = 0
    """Samples of the window that were dropped because the action was too slow."""


class OutcomeState(StrEnum):
    """The progress of an action with an episode."""

    RUNNING = "Running"
    DONE = "Done"
    FAILED = "Failed"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an action reports about its work for one episode."""

    state: OutcomeState
    message: str = ""
    """Why it failed, or other information."""
    samples: int = 0
    bytes: int = 0
    missing: int = 0
    """Number of samples, messages or the like that were lost."""
    files: tuple[str, ...] = ()
    details: Mapping[str, JsonValue] = field(default_factory=dict)
    """Further details, in camelCase."""
