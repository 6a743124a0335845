"""The database action: an episode becomes a scenario in MongoDB, with the samples of its window as documents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import JsonValue, Model, PositiveDuration, PositiveQuantity
from wayside.api.freedata import NamedData

DatabaseName = Annotated[str, Field(min_length=1, max_length=63, pattern=r"^[A-Za-z0-9_-]+$")]
"""A name that MongoDB accepts on every platform."""


class Attachments(Model):
    """Which data is written to files outside the database."""

    above: PositiveQuantity = PositiveQuantity("64Ki")
    """Binary fields larger than this are written to files: images as PNG, point clouds as PCD, other data unchanged.
    Smaller fields stay in the documents."""


class DatabaseAction(Window):
    """Writes the samples of the episode's window to the Detector's database, as one scenario."""

    database: DatabaseName = "wayside"
    """The name of the database on the server."""
    metadata: NamedData = Field(default_factory=dict)
    """Additional fields of the scenario, such as the driver. Values can contain ${…} with the rule's variables at the
    start of the episode."""
    renew_after: PositiveDuration | None = None
    """Completes the scenario after this time and continues in a new one, for rules whose episodes never end. Each
    sample is in exactly one scenario. Default: one scenario per episode."""
    files: Attachments | None = None
    """Which data is written to files. Default: binary fields above 64Ki if the Detector has database.files, otherwise
    none."""
    dry_run: bool = False
    """If true, documents are built, counted and measured, but not written."""

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """The values that are rendered for each episode."""
        return {"metadata": self.metadata} if self.metadata else {}
