"""Requests to another system about one recording, and its reports: the same for every kind of system."""

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
    """It was not started; the message gives the reason."""
    UNKNOWN = "Unknown"
    """Nothing is known of such a recording."""

    @property
    def over(self) -> bool:
        """Whether nothing is recorded any more, and never will be."""
        return self in (Progress.DONE, Progress.FAILED, Progress.REFUSED, Progress.UNKNOWN)


@dataclass(frozen=True, slots=True)
class Report:
    """The report of another system about a recording."""

    progress: Progress
    message: str = ""
    samples: int = 0
    bytes: int = 0
    missing: int = 0
    files: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Order:
    """One recording in another system. All that is needed to request it again after a restart."""

    id: str
    """`<holder>.<rule>.<action>.<episode>`: a repeated request with it has no further effect."""
    rendered: Mapping[str, JsonValue]
    """The action's templates."""
    event: Mapping[str, Any] = field(default_factory=dict)
    """The CloudEvent of the start."""


class System(Protocol):
    """Another system that records. Its methods wait for the network, and raise ActionError if there is no answer."""

    renew: float | None
    """Seconds after which a start is repeated, so that a restarted system continues; None: never."""
    timeout: float
    """Seconds to wait for an answer."""
    ends_by_itself: bool
    """Whether it ends a recording after maximumDuration by itself."""

    def place(self, order: Order) -> str:
        """The system that receives it: all orders of one place are silent together. Raises ActionError if the order
        names none.
        """

    def start(self, order: Order, ago: float, *, again: bool) -> Report:
        """Record from the onset, `ago` seconds ago; `again` if it was confirmed before."""

    def stop(self, order: Order, ago: float) -> Report:
        """End the recording; the episode ended `ago` seconds ago."""

    def status(self, order: Order) -> Report:
        """How far it is."""


def nested_value(value: Any, *names: str) -> Any:
    """What lies under these names in maps within maps; None where there is none."""
    for name in names:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value
