"""Actions that installed packages bring: which one, and what it is to do."""

from __future__ import annotations

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import Identifier, JsonValue, Model
from wayside.api.source import PluginName


class ActionPlugin(Model):
    """An action of an installed package, and how it is to act."""

    name: PluginName = Field(description="What acts: what an installed package offers as wayside.actions.")
    parameters: dict[str, JsonValue] = Field(
        default_factory=dict,
        description="What the plugin asks for; see its documentation.",
        json_schema_extra={"type": "object", "x-kubernetes-preserve-unknown-fields": True, "maxProperties": 64},
    )
    values: dict[Identifier, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="What it is told of each episode, with ${…} over the rule's variables at the start.",
    )
    window: Window | None = Field(default=None, description="The samples that it gets. Default: none.")
