"""Sources of samples other than Zenoh: plugins, each with its own parameters."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from wayside.api.base import Model, ObjectName
from wayside.api.freedata import FreeData

ZENOH = "zenoh"
"""The default source of a stream: the session of `spec.zenoh`."""

PluginName = Annotated[str, Field(min_length=1, max_length=63, pattern=r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$")]
"""The name of an entry point."""


class DataSource(Model):
    """A plugin that receives samples, and its parameters."""

    name: ObjectName = Field(description="The name by which streams refer to the source.")
    plugin: PluginName = Field(
        description="The plugin: mqtt, bag, or the name of a wayside.sources entry point of an installed package."
    )
    parameters: FreeData = Field(
        default_factory=dict,
        description="The parameters of the plugin; see its documentation.",
    )
