"""What evaluation gives: events, each with its place in the order of all."""

from __future__ import annotations

from typing import NamedTuple

from detector.engine.episodes.events import Event


class Happened(NamedTuple):
    """An event, and where it belongs in the order of all."""

    time: int
    order: int
    """The rule's place among the rules."""
    event: Event
