"""Where a Detector's recordings go, and how much room they may take."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from wayside.api.base import Model, PositiveDuration, PositiveQuantity, Quantity


class WhenFull(StrEnum):
    """What gives way where a recording finds no room."""

    DROP_OLDEST = "DropOldest"
    STOP = "Stop"


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
