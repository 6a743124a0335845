"""The database that a detector writes scenarios to: where it is, and what happens while it is away."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field, model_validator

from wayside.api.access import FilePath, Variable
from wayside.api.base import Model, ObjectName, PositiveQuantity, validations

_ONE = "give the place of the database's URI once: uriSecret, uriVariable or uriFile"


class WriteConcern(StrEnum):
    """When a write counts as done."""

    MAJORITY = "Majority"
    ONE = "One"


class Spool(Model):
    """Where documents wait while the database is away."""

    path: FilePath = Field(
        description="A folder on a volume that outlives the process, e.g. /var/lib/wayside/spool. It is made where it "
        "is missing, and belongs to one detector."
    )
    bytes: PositiveQuantity = Field(
        default=PositiveQuantity("1Gi"),
        description="At most so much waits on the disk. Beyond it new documents are dropped and counted, so that the "
        "scenarios that wait already stay whole.",
    )


class DatabaseFiles(Model):
    """Where images, point clouds and other large data are written beside the database."""

    path: FilePath = Field(description="A folder; documents refer to the files by their path below it.")
    bytes: PositiveQuantity | None = Field(
        default=None,
        description="At most so much lies there: what is beyond is left out of the documents, and counted. Default: no "
        "limit but the disk's.",
    )


class Database(Model):
    """A MongoDB server or replica set, and what is kept outside it."""

    model_config = validations(
        ("[has(self.uriSecret), has(self.uriVariable), has(self.uriFile)].filter(given, given).size() == 1", _ONE)
    )

    uri_secret: ObjectName | None = Field(
        default=None, description="A Secret whose key `uri` holds the connection string, mongodb://… with credentials."
    )
    uri_variable: Variable | None = Field(
        default=None, description="The environment variable that holds the connection string."
    )
    uri_file: FilePath | None = Field(
        default=None, description="The file that holds the connection string; a newline at its end does not count."
    )
    write_concern: WriteConcern = Field(
        default=WriteConcern.MAJORITY,
        description="Majority: a document counts as written once most members of the replica set have it. One: once "
        "the primary has it, which a change of the primary can undo.",
    )
    spool: Spool | None = Field(
        default=None,
        description="Where documents wait while the database is away. Without it 64 MiB wait in memory, and are lost "
        "with the process.",
    )
    files: DatabaseFiles | None = Field(
        default=None, description="Where large binary data goes. Without it, it stays in the documents."
    )

    @model_validator(mode="after")
    def _one_place(self) -> Database:
        if [self.uri_secret, self.uri_variable, self.uri_file].count(None) != 2:
            raise ValueError(_ONE)
        return self
