"""Requests to another system about one recording, and its reports.

Between detectors both are JSON. A request is the payload of a query on `wayside/detectors/<name>/recordings`. Without a
payload, the query requests the status of all recordings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Literal, Protocol

import msgspec
from pydantic import Field, ValidationError

from wayside.api.base import ClientName, Duration, JsonValue, Model, ObjectName, PositiveDuration
from wayside.times import format_time


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
    """Whether it ends a recording by itself after maxDuration."""

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


RECORDINGS = "recordings"
"""The name of the request in the key of the detector."""

MAXIMUM_BYTES = 65_536
"""Maximum size of a request."""

MAXIMUM_CLIENTS = 256
"""Maximum number of clients in a request. A requester with more clients requests all."""

RecordingId = Annotated[str, Field(min_length=1, max_length=512, pattern=r"^[A-Za-z0-9_.:~+%-]+$")]


class RecordingRequest(Model):
    """A query or an order about a recording."""

    do: Literal["start", "stop", "status"] = "status"
    id: RecordingId | None = None
    """Chosen by the requester. A repeated request with this id has no further effect."""
    streams: list[ObjectName] | None = Field(default=None, max_length=128)
    """For a start; default: all that the detector records on request."""
    clients: list[ClientName] | None = Field(default=None, max_length=MAXIMUM_CLIENTS)
    """For a start; default: all."""
    before: Duration = Duration("0s")
    """For a start: the duration before `ago` that is recorded."""
    after: Duration = Duration("0s")
    """For a stop: the duration after `ago` that is still recorded."""
    ago: Duration = Duration("0s")
    """How long ago the cause of a start began, or that of a stop ended. Relative: clocks of machines differ."""
    max_duration: PositiveDuration = PositiveDuration("10m")
    """For a start: the maximum duration."""
    event: dict[str, JsonValue] = Field(default_factory=dict)
    """For a start: the CloudEvent that causes it; it is stored in the recording."""


class RecordingReport(msgspec.Struct, frozen=True, rename="camel"):
    """The report of a detector about one recording."""

    id: str
    state: Progress
    message: str = ""
    streams: list[str] = []
    since: str = ""
    """RFC 3339, by the clock of the recording detector."""
    until: str = ""
    """When it ended, or will end at the latest."""
    samples: int = 0
    bytes: int = 0
    missing: int = 0
    files: list[str] = []
    """Paths on the recording detector."""


def duration(seconds: float) -> Duration:
    """The duration to the millisecond, in the form of requests."""
    return Duration(f"{min(max(0, round(seconds * 1000)), 999_999_999)}ms")


def short(event: Mapping[str, Any]) -> dict[str, Any]:
    """The event in the form of a request: without its values if they make it too long, as a fleet's may."""
    if len(msgspec.json.encode(event)) <= MAXIMUM_BYTES // 2:
        return dict(event)
    cause: dict[str, Any] = {key: value for key, value in event.items() if key != "data"}
    data = event.get("data")
    if isinstance(data, Mapping):
        cause["data"] = {key: value for key, value in data.items() if key not in ("values", "subjects")}
    return cause


def read_request(payload: bytes) -> RecordingRequest:
    """The request in a query. Raises ValueError."""
    if not payload:
        return RecordingRequest()
    if len(payload) > MAXIMUM_BYTES:
        raise ValueError(f"a request may have at most {MAXIMUM_BYTES} bytes; got {len(payload)}")
    try:
        request = RecordingRequest.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the request"
        raise ValueError(f"{where}: {first['msg']}") from None
    if request.do != "status" and request.id is None:
        raise ValueError(f"id is missing: {request.do} requires the id of the recording")
    return request


def write_request(request: RecordingRequest) -> bytes:
    """The payload of a query."""
    return msgspec.json.encode(request.model_dump(mode="json", by_alias=True, exclude_defaults=True))


def write_reports(reports: RecordingReport | list[RecordingReport]) -> bytes:
    """The response: one report, or those of all recordings."""
    return msgspec.json.encode(reports)


def read_report(payload: bytes) -> RecordingReport:
    """The report about one recording from a response. Raises ValueError."""
    return msgspec.json.decode(payload, type=RecordingReport)


def read_reports(payload: bytes) -> list[RecordingReport]:
    """The reports about all recordings, or about one, from a response. Raises ValueError."""
    answer: Any = msgspec.json.decode(payload)
    return msgspec.convert(answer if isinstance(answer, list) else [answer], list[RecordingReport])


def time_text(nanoseconds: int | None) -> str:
    """A time since the epoch in the form of reports; empty for None."""
    return "" if nanoseconds is None else format_time(nanoseconds)
