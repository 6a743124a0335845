"""Requests of one detector to another about recordings, and the responses, in JSON.

A request is the payload of a query of `wayside/detectors/<name>/recordings`. Without one, the query requests the status
of all recordings.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from pydantic import Field, ValidationError

from detector.actions.trigger.orders import Progress
from wayside.api.base import ClientName, Duration, JsonValue, Model, ObjectName, PositiveDuration
from wayside.times import format_time

RECORDINGS = "recordings"
"""The request, in the key of the detector."""

MAXIMUM_BYTES = 65_536
"""Of a request."""

MAXIMUM_CLIENTS = 256
"""Of a request. Who means more means all."""

RecordingId = Annotated[str, Field(min_length=1, max_length=512, pattern=r"^[A-Za-z0-9_.:~+%-]+$")]


class RecordingRequest(Model):
    """A question or an order about a recording."""

    do: Literal["start", "stop", "status"] = "status"
    id: RecordingId | None = None
    """The requester chooses it. A repeated request with it has no further effect."""
    streams: list[ObjectName] | None = Field(default=None, max_length=128)
    """Start: default: all that the detector records on request."""
    clients: list[ClientName] | None = Field(default=None, max_length=MAXIMUM_CLIENTS)
    """Start: default: all."""
    before: Duration = Duration("0s")
    """Start: from so long before `ago`."""
    after: Duration = Duration("0s")
    """Stop: until so long after `ago`."""
    ago: Duration = Duration("0s")
    """Start: when the cause began. Stop: when it ended. Relative, since two machines seldom agree on the time."""
    maximum_duration: PositiveDuration = PositiveDuration("10m")
    """Start: it ends then, whatever happens."""
    event: dict[str, JsonValue] = Field(default_factory=dict)
    """Start: the CloudEvent that it is about; it goes into the recording."""


class RecordingReport(msgspec.Struct, frozen=True, rename="camel"):
    """The report of a detector about one recording."""

    id: str
    state: Progress
    message: str = ""
    streams: list[str] = []
    since: str = ""
    """RFC 3339, of the detector that records."""
    until: str = ""
    """When it ended, or will at the latest."""
    samples: int = 0
    bytes: int = 0
    missing: int = 0
    files: list[str] = []
    """As the detector that records sees them."""


def duration(seconds: float) -> Duration:
    """The duration to the millisecond, as requests write it."""
    return Duration(f"{min(max(0, round(seconds * 1000)), 999_999_999)}ms")


def short(event: Mapping[str, Any]) -> dict[str, Any]:
    """The event as a request carries it: without its values where they make it too long, as a fleet's may."""
    if len(msgspec.json.encode(event)) <= MAXIMUM_BYTES // 2:
        return dict(event)
    cause: dict[str, Any] = {key: value for key, value in event.items() if key != "data"}
    data = event.get("data")
    if isinstance(data, Mapping):
        cause["data"] = {key: value for key, value in data.items() if key not in ("values", "subjects")}
    return cause


def read_request(payload: bytes) -> RecordingRequest:
    """The request that a query carries. Raises ValueError."""
    if not payload:
        return RecordingRequest()
    if len(payload) > MAXIMUM_BYTES:
        raise ValueError(f"a request of {len(payload)} bytes is too long: at most {MAXIMUM_BYTES}")
    try:
        request = RecordingRequest.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the request"
        raise ValueError(f"{where}: {first['msg']}") from None
    if request.do != "status" and request.id is None:
        raise ValueError(f"{request.do}: give the id of the recording")
    return request


def write_request(request: RecordingRequest) -> bytes:
    """The payload of a query."""
    return msgspec.json.encode(request.model_dump(mode="json", by_alias=True, exclude_defaults=True))


def write_reports(reports: RecordingReport | list[RecordingReport]) -> bytes:
    """The answer: one report, or those of all recordings."""
    return msgspec.json.encode(reports)


def read_report(payload: bytes) -> RecordingReport:
    """What was answered about one recording. Raises ValueError."""
    return msgspec.json.decode(payload, type=RecordingReport)


def read_reports(payload: bytes) -> list[RecordingReport]:
    """What was answered about all recordings, or about one. Raises ValueError."""
    answer: Any = msgspec.json.decode(payload)
    return msgspec.convert(answer if isinstance(answer, list) else [answer], list[RecordingReport])


def time_text(nanoseconds: int | None) -> str:
    """A time since the epoch as reports write it; empty for None."""
    return "" if nanoseconds is None else format_time(nanoseconds)
