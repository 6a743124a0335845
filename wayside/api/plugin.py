"""Signals that plugins compute: which plugin, and what it is to do."""

from __future__ import annotations

from pydantic import Field

from wayside.api.base import JsonValue, Model
from wayside.api.source import PluginName


class SignalPlugin(Model):
    """A plugin that computes a signal, and how it is to do it."""

    name: PluginName = Field(
        description="What computes it: unmatched-objects, or what an installed package offers as wayside.signals."
    )
    parameters: dict[str, JsonValue] = Field(
        default_factory=dict,
        description="What the plugin asks for; see its documentation.",
        json_schema_extra={"type": "object", "x-kubernetes-preserve-unknown-fields": True, "maxProperties": 64},
    )
