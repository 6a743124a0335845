"""The results of evaluation: events, each with its position in the overall order."""

from __future__ import annotations

from typing import NamedTuple

from detector.engine.episodes.events import Event


class Happened(NamedTuple):
    """An event and its position in the overall order."""

    time: int
    order: int
    """The rule's position among the rules."""
    event: Event
