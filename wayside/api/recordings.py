"""Where a Detector's recordings go, and how much room they may take."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from wayside.api.base import Model, ObjectName, PositiveDuration, PositiveQuantity, Quantity


class WhenFull(StrEnum):
    """What gives way where a recording finds no room."""

    DROP_OLDEST = "DropOldest"
    STOP = "Stop"


class OnRequest(Model):
    """Recordings that others ask for over Zenoh: a trigger of another detector, or anyone else who reaches it."""

    streams: list[ObjectName] | None = Field(
        default=None,
        min_length=1,
        max_length=128,
        description="The streams that may be recorded; latched ones always come with them. Default: all.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )
    maximum_duration: PositiveDuration = Field(
        default=PositiveDuration("1h"), description="A recording ends after so long, even where more was asked for."
    )
    maximum_recordings: int = Field(default=8, ge=1, le=100, description="So many at a time; further ones are refused.")


class Recordings(Model):
    """The folder of all recordings of a Detector, and its limits over all rules together."""

    path: str = Field(
        min_length=1,
        max_length=1024,
        description="The folder, e.g. /var/lib/wayside/recordings, made where it is missing. Each detector needs one "
        "of its own: the limits are for what one process writes, and finds there.",
    )
    bytes: PositiveQuantity = Field(
        default=PositiveQuantity("16Gi"), description="The recordings take no more than this together."
    )
    files: int | None = Field(
        default=None, ge=1, le=10_000_000, description="No more MCAP files than this. Default: no limit."
    )
    age: PositiveDuration | None = Field(
        default=None,
        description="Recordings that ended longer ago are deleted, whatever whenFull says. Default: never.",
    )
    reserve: Quantity = Field(
        default=Quantity("1Gi"), description="So much of the disk is left free, whoever else writes to it."
    )
    when_full: WhenFull = Field(
        default=WhenFull.DROP_OLDEST,
        description="DropOldest: the oldest recordings are deleted for new ones, but none in progress. Stop: what "
        "there is stays, and recordings that find no room end, marked as cut.",
    )
    on_request: OnRequest | None = Field(
        default=None, description="Lets others ask for recordings. Default: nobody can."
    )
