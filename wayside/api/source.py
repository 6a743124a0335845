"""Sources of samples other than Zenoh: plugins, each with parameters of its own."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from wayside.api.base import JsonValue, Model, ObjectName

ZENOH = "zenoh"
"""The source of a stream that names none: the session of `spec.zenoh`."""

PluginName = Annotated[str, Field(min_length=1, max_length=63, pattern=r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$")]
"""The name of an entry point."""


class DataSource(Model):
    """A plugin that brings samples, and how it is to do it."""

    name: ObjectName = Field(description="The name by which streams refer to the source.")
    plugin: PluginName = Field(
        description="What brings the samples: mqtt, bag, or what an installed package offers as wayside.sources."
    )
    parameters: dict[str, JsonValue] = Field(
        default_factory=dict,
        description="What the plugin asks for; see its documentation.",
        json_schema_extra={"type": "object", "x-kubernetes-preserve-unknown-fields": True, "maxProperties": 64},
    )
