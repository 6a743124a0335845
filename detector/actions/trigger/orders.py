"""What is asked of another system about one recording, and what it says: the same words for every kind of system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from wayside.api.base import JsonValue


class Progress(StrEnum):
    """How far a recording elsewhere has come."""

    RECORDING = "Recording"
    ENDING = "Ending"
    """Told to stop; the last samples are still to come."""
    DONE = "Done"
    FAILED = "Failed"
    REFUSED = "Refused"
    """It was not begun, and the message says why."""
    UNKNOWN = "Unknown"
    """Nothing is known of such a recording."""

    @property
    def over(self) -> bool:
        """Whether nothing is recorded any more, and never will be."""
        return self in (Progress.DONE, Progress.FAILED, Progress.REFUSED, Progress.UNKNOWN)


@dataclass(frozen=True, slots=True)
class Report:
    """What another system says of a recording."""

    progress: Progress
    message: str = ""
    samples: int = 0
    bytes: int = 0
    missing: int = 0
    files: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Order:
    """One recording in another system. All that is needed to ask for it again after a restart."""

    id: str
    """`<holder>.<rule>.<action>.<episode>`: whoever is asked twice under it does it once."""
    rendered: Mapping[str, JsonValue]
    """The action's templates."""
    event: Mapping[str, Any] = field(default_factory=dict)
    """The CloudEvent of the start."""


class System(Protocol):
    """Another system that records. Its methods wait for the network, and raise ActionError where nobody answers."""

    renew: float | None
    """Seconds after which a start is said again, so that a system that was restarted goes on; None: never."""
    timeout: float
    """Seconds to wait for an answer."""
    ends_by_itself: bool
    """Whether it ends a recording after maximumDuration without being told."""

    def place(self, order: Order) -> str:
        """Who is asked: those of one place are silent together. Raises ActionError where the order does not say."""

    def start(self, order: Order, ago: float, *, again: bool) -> Report:
        """Record, from the onset, which was so many seconds ago; `again` where it has been confirmed before."""

    def stop(self, order: Order, ago: float) -> Report:
        """End the recording; the episode ended so many seconds ago."""

    def status(self, order: Order) -> Report:
        """How far it is."""


def member(value: Any, *names: str) -> Any:
    """What lies under these names in maps within maps; None where there is none."""
    for name in names:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value
