"""ASN.1 modules that a Detector's user brings, for ETSI ITS messages that no package defines."""

from __future__ import annotations

from pydantic import Field

from wayside.api.base import Model
from wayside.api.constraints import exactly_one


class Asn1Module(Model):
    """One or several ASN.1 modules, in the Detector itself or in a file."""

    constraints = (exactly_one("definition", "file"),)

    definition: str | None = Field(default=None, min_length=1, max_length=500_000)
    """The text of the modules."""
    file: str | None = Field(default=None, min_length=1, max_length=1024)
    """The path of a file with the modules, as the detector sees it: relative to its working directory, or on a mounted
    volume."""
