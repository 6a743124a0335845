"""A Helm chart as an application: which one, and the values that it is rendered with."""

from __future__ import annotations

from typing import Any

from pydantic import Field, model_validator

from wayside.api.base import Model
from wayside.api.constraints import constraint

OCI = "oci://"

_FORMS = (
    "write oci://… with a version, the name of a chart with its repository and version, or the absolute "
    "path of a folder or archive in the manager's image"
)
_VERSION = r"^v?[0-9]+(\.[0-9]+){0,2}(-[0-9A-Za-z.-]+)?(\+[0-9A-Za-z.-]+)?$"


class Helm(Model):
    """A chart and its values."""

    constraints = (
        constraint(
            "self.chart.startsWith('/') ? !has(self.version) && !has(self.repository) : has(self.version)",
            "a chart from a registry or repository needs version; for a path, remove version and repository",
            ".version",
        ),
        constraint(
            "self.chart.startsWith('/') || self.chart.startsWith('oci://') != has(self.repository)",
            "a chart name needs repository; for oci://…, remove repository",
            ".repository",
        ),
    )

    # No `-` at the beginning: it is an argument of a program.
    chart: str = Field(
        min_length=1, max_length=512, pattern=r"^(oci://[a-zA-Z0-9][^ ?#@]*|/[^ ]+|[a-zA-Z0-9][a-zA-Z0-9._-]*)$"
    )
    """The chart: an OCI reference (oci://…), the name of a chart in `repository`, or an absolute path in the manager's
    image."""
    version: str | None = Field(default=None, max_length=128, pattern=_VERSION)
    """The exact version of the chart. Ranges are not allowed: the same template must always render the same objects.
    Required unless chart is a path."""
    repository: str | None = Field(default=None, max_length=512, pattern=r"^https?://[^ ]+$")
    """The URL of the chart repository. Only for a chart given by name."""
    values: dict[str, Any] = Field(
        default_factory=dict, json_schema_extra={"x-kubernetes-preserve-unknown-fields": True}
    )
    """The values of the chart, with ${…} over parameters and instance (name, key, namespace, configMap)."""

    @model_validator(mode="after")
    def _one_place(self) -> Helm:
        if self.chart.startswith("/"):
            if self.version is not None or self.repository is not None:
                raise ValueError(f"chart {self.chart} is a path, which has neither version nor repository: remove them")
        elif self.version is None:
            raise ValueError(f"chart {self.chart} needs an exact version: {_FORMS}")
        elif self.chart.startswith(OCI) == (self.repository is not None):
            raise ValueError(f"the location of chart {self.chart} is unclear: {_FORMS}")
        return self
