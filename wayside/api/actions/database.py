"""The database action: an episode becomes a scenario in MongoDB, with the samples of its window as documents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import Identifier, JsonValue, Model, PositiveDuration, PositiveQuantity

DatabaseName = Annotated[str, Field(min_length=1, max_length=63, pattern=r"^[A-Za-z0-9_-]+$")]
"""A name that MongoDB takes on every platform."""


class Attachments(Model):
    """Which data is written to files beside the database."""

    above: PositiveQuantity = Field(
        default=PositiveQuantity("64Ki"),
        description="Binary fields larger than this go to files: images as PNG, point clouds as PCD, others as they "
        "are. Smaller ones stay in the documents.",
    )


class DatabaseAction(Window):
    """Write the samples of the episode's window to the Detector's database, as one scenario."""

    database: DatabaseName = Field(default="wayside", description="The name of the database on the server.")
    metadata: dict[Identifier, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="Facts to keep with the scenario, such as who drove, with ${…} over the rule's variables at the "
        "start of the episode.",
    )
    renew_after: PositiveDuration | None = Field(
        default=None,
        description="After this time the scenario is completed, and the episode goes on in another: no sample is "
        "missing or in both. For rules whose episodes never end. Default: one scenario for each episode.",
    )
    files: Attachments | None = Field(
        default=None,
        description="Which data goes to files beside. Default: binary fields above 64Ki where the Detector has "
        "database.files, else none.",
    )
    dry_run: bool = Field(
        default=False,
        description="true: documents are made, counted and measured, but nothing is written anywhere.",
    )

    @property
    def templates(self) -> Mapping[str, JsonValue]:
        """What is rendered for each episode."""
        return {"metadata": self.metadata} if self.metadata else {}
