"""The episode in the form that an action receives: its events, its rendered values, and its samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from detector.engine.consequences import EpisodeSample
from detector.engine.episodes.record import EpisodeRecord
from wayside.api.base import JsonValue

__all__ = ["Completion", "Episode", "EpisodeSample", "Outcome", "OutcomeState"]


class Episode(EpisodeRecord, frozen=True, gc=False, kw_only=True):
    """The record of an episode, with what one action needs beside it. Times are nanoseconds since the epoch."""

    rendered: Mapping[str, JsonValue]
    """The action's templates, rendered at the start (or see `rendered_again`), as far as they could be rendered."""
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
    """The report of an action about its work for one episode."""

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
