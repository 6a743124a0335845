"""Actions that installed packages bring: which one, and what it is to do."""

from __future__ import annotations

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import Identifier, JsonValue, Model
from wayside.api.source import PluginName


class ActionPlugin(Model):
    """An action of an installed package, and its parameters."""

    name: PluginName = Field(
        description="The plugin: the name of a wayside.actions entry point of an installed package."
    )
    parameters: dict[str, JsonValue] = Field(
        default_factory=dict,
        description="The parameters of the plugin; see its documentation.",
        json_schema_extra={"type": "object", "x-kubernetes-preserve-unknown-fields": True, "maxProperties": 64},
    )
    values: dict[Identifier, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="Values that the plugin receives for each episode, with ${…} over the rule's variables at the "
        "start of the episode.",
    )
    window: Window | None = Field(default=None, description="The samples that the plugin receives. Default: none.")
