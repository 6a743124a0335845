"""The database that a detector writes scenarios to: its connection, its spool and its files."""

from __future__ import annotations

from enum import StrEnum

from wayside.api.access import FilePath, Variable
from wayside.api.base import Model, PositiveQuantity, SubdomainName
from wayside.api.constraints import exactly_one


class WriteConcern(StrEnum):
    """When a write is acknowledged."""

    MAJORITY = "Majority"
    ONE = "One"


class DatabaseSpool(Model):
    """The buffer of documents on disk while the database is unavailable."""

    path: FilePath
    """The spool folder, on a volume that outlives the process, e.g. /var/lib/wayside/spool. It is created if missing.
    Each detector needs its own."""
    bytes: PositiveQuantity = PositiveQuantity("1Gi")
    """The maximum size of the spool. At the limit, new documents are dropped and counted, so that scenarios already in
    the spool stay complete."""


class DatabaseFiles(Model):
    """The storage of images, point clouds and other large data outside the database."""

    path: FilePath
    """The folder. Documents refer to the files by their path relative to it."""
    bytes: PositiveQuantity | None = None
    """The maximum size of the folder. At the limit, further data is omitted from the documents and counted. Default:
    limited only by the disk."""


class DatabaseConnection(Model):
    """A MongoDB server or replica set, with the spool and the files of the detector."""

    constraints = (exactly_one("uri_secret_name", "uri_variable", "uri_file"),)

    uri_secret_name: SubdomainName | None = None
    """A Secret whose key `uri` contains the connection string, mongodb://… with credentials."""
    uri_variable: Variable | None = None
    """The environment variable that contains the connection string."""
    uri_file: FilePath | None = None
    """The file that contains the connection string. A trailing newline is ignored."""
    write_concern: WriteConcern = WriteConcern.MAJORITY
    """When a document counts as written. Majority: a majority of the replica set has it. One: the primary has it; a
    failover can still roll the write back."""
    spool: DatabaseSpool | None = None
    """Buffers documents on disk while the database is unavailable. Without a spool, up to 64 MiB are buffered in memory
    and lost when the process ends."""
    files: DatabaseFiles | None = None
    """Stores large binary data in files. Without it, the data stays in the documents."""
