"""Requests to another system about one recording, and its reports: the same for every kind of system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from wayside.api.base import JsonValue


class Progress(StrEnum):
    """The progress of a recording elsewhere."""

    RECORDING = "Recording"
    ENDING = "Ending"
    """Stop requested; the last samples are still to come."""
    DONE = "Done"
    FAILED = "Failed"
    REFUSED = "Refused"
    """It was not started; the message gives the reason."""
    UNKNOWN = "Unknown"
    """The recording is unknown."""

    @property
    def over(self) -> bool:
        """Whether the recording has ended for good."""
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
    """One recording in another system, with everything needed to request it again after a restart."""

    id: str
    """`<holder>.<rule>.<action>.<episode>`: a repeated request with this id has no further effect."""
    rendered: Mapping[str, JsonValue]
    """The action's templates."""
    event: Mapping[str, Any] = field(default_factory=dict)
    """The CloudEvent of the start."""

    def to_json(self) -> dict[str, Any]:
        """As a JSON object for the journal."""
        return {"id": self.id, "rendered": self.rendered, "event": self.event}


def order_from(document: Mapping[str, Any]) -> Order:
    """The order from what `to_json` returned."""
    return Order(**document)


class RecordingSystem(Protocol):
    """Another system that records. Its methods wait for the network, and raise ActionError if there is no response."""

    renew: float | None
    """Seconds after which a start is repeated, so that a restarted system continues; None: never."""
    timeout: float
    """Seconds to wait for a response."""
    ends_by_itself: bool
    """Whether it ends a recording by itself after maximumDuration."""

    def place(self, order: Order) -> str:
        """The system that receives the order: if it does not respond, all orders with this place wait. Raises
        ActionError if the order names none.
        """

    def start(self, order: Order, ago: float, *, again: bool) -> Report:
        """Start recording from the onset, `ago` seconds ago; `again` if it was confirmed before."""

    def stop(self, order: Order, ago: float) -> Report:
        """Stop recording; the episode ended `ago` seconds ago."""

    def status(self, order: Order) -> Report:
        """Request its progress."""


def nested_value(value: Any, *names: str) -> Any:
    """The value under these names in nested maps; None if there is none."""
    for name in names:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value
