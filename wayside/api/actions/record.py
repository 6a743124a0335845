"""The record action: the samples of an episode's window become a rosbag2 folder with MCAP files."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import ClassVar

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import JsonValue, Model, PositiveDuration, PositiveQuantity
from wayside.api.freedata import FreeData


class Compression(StrEnum):
    """How the chunks of a recording are compressed."""

    NONE = "None"
    LZ4 = "Lz4"
    ZSTD = "Zstd"


class Split(Model):
    """When a recording continues in a new file. Each file is readable on its own."""

    bytes: PositiveQuantity | None = None
    """The approximate maximum size of a file."""
    duration: PositiveDuration | None = None
    """The maximum time span of a file."""


class RecordAction(Window):
    """Records the window as rosbag2 with MCAP files, in the Detector's `recordings` folder."""

    templates_in: ClassVar[tuple[str, ...]] = ("metadata",)

    compression: Compression = Compression.NONE
    """The compression of the chunks: None, Lz4 (faster) or Zstd (smaller). Readers detect the compression."""
    split: Split = Split()
    """When to continue in a new file. Default: never."""
    renew_after: PositiveDuration | None = None
    """Completes the recording after this time and continues in a new one, for rules whose episodes never end. Each
    sample is in exactly one recording. Default: one recording per episode."""
    metadata: FreeData = Field(default_factory=dict)
    """Additional metadata of the recording. Values can contain ${…} with the rule's variables at the start of the
    episode."""

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """The values that are rendered for each episode."""
        return self.metadata
