"""The record action: the samples of an episode's window become a rosbag2 folder with MCAP files."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import JsonValue, Model, PositiveDuration, PositiveQuantity


class Compression(StrEnum):
    """How the chunks of a recording are compressed."""

    NONE = "None"
    LZ4 = "Lz4"
    ZSTD = "Zstd"


class Split(Model):
    """When a recording goes on in another file; each file can be read on its own."""

    bytes: PositiveQuantity | None = Field(default=None, description="A file has at most about this size.")
    duration: PositiveDuration | None = Field(default=None, description="A file spans at most this time.")


class Record(Window):
    """Record the window as rosbag2 with MCAP files, in the Detector's `recordings` folder."""

    templates_in: ClassVar[tuple[str, ...]] = ("metadata",)

    compression: Compression = Field(
        default=Compression.NONE, description="None, Lz4 (fast), or Zstd (smaller). Readers need not be told."
    )
    split: Split = Field(default=Split(), description="When to go on in another file. Default: never.")
    renew_after: PositiveDuration | None = Field(
        default=None,
        description="After this time the recording is completed, and the episode goes on in another: no sample is "
        "missing or in both. For rules whose episodes never end. Default: one recording for each episode.",
    )
    metadata: dict[Annotated[str, Field(min_length=1, max_length=63)], JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="What else the recording shall say of itself, with ${…} over the rule's variables at the start of "
        "the episode.",
    )

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """What is rendered for each episode."""
        return self.metadata
