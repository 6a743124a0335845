"""ASN.1 modules that a Detector's user brings, for ETSI ITS messages that no package defines."""

from __future__ import annotations

from pydantic import Field, model_validator

from wayside.api.base import Model, validations

_ONE = "give exactly one of definition and file"


class Asn1Module(Model):
    """One or several ASN.1 modules, in the Detector itself or in a file."""

    model_config = validations(("has(self.definition) != has(self.file)", _ONE))

    definition: str | None = Field(default=None, min_length=1, max_length=500_000)
    """The text of the modules."""
    file: str | None = Field(default=None, min_length=1, max_length=1024)
    """The path of a file with the modules, as the detector sees it: relative to its working directory, or on a mounted
    volume."""

    @model_validator(mode="after")
    def _one(self) -> Asn1Module:
        if (self.definition is None) == (self.file is None):
            raise ValueError(_ONE)
        return self
