"""The storage of a Detector's recordings, and its limits."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from wayside.api.access import FilePath
from wayside.api.base import SET_LIST, Model, ObjectName, PositiveDuration, PositiveQuantity, Quantity


class WhenFull(StrEnum):
    """What happens when the storage is full."""

    DROP_OLDEST = "DropOldest"
    STOP = "Stop"


class OnRequest(Model):
    """Recordings that others request over Zenoh: a trigger of another detector, or any other peer."""

    streams: list[ObjectName] | None = Field(default=None, min_length=1, max_length=128, json_schema_extra=SET_LIST)
    """The streams that may be recorded. Latched streams are always included. Default: all."""
    max_duration: PositiveDuration = PositiveDuration("1h")
    """The maximum duration of a recording. A recording ends after this time, even if the request exceeds it."""
    max_recordings: int = Field(default=8, ge=1, le=100)
    """The maximum number of concurrent recordings on request. Further requests are refused."""


class Recordings(Model):
    """The folder of all recordings of a Detector, with limits for all rules together."""

    path: FilePath
    """The folder, e.g. /var/lib/wayside/recordings. It is created if missing. Each detector needs its own, since the
    limits apply to everything in the folder and assume a single writer."""
    bytes: PositiveQuantity = PositiveQuantity("16Gi")
    """The maximum size of all recordings together. At the limit, whenFull applies."""
    files: int | None = Field(default=None, ge=1, le=10_000_000)
    """The maximum number of MCAP files. At the limit, whenFull applies. Default: no limit."""
    age: PositiveDuration | None = None
    """Recordings are deleted this long after their end, regardless of whenFull. Default: never."""
    reserve: Quantity = Quantity("1Gi")
    """The minimum free disk space. Files of other programs count too. At the limit, whenFull applies."""
    when_full: WhenFull = WhenFull.DROP_OLDEST
    """DropOldest: the oldest complete recordings are deleted. Stop: existing recordings are kept; a recording that
    reaches the limit ends and is marked as cut."""
    on_request: OnRequest | None = None
    """Allows others to request recordings. Default: not allowed."""
