"""Signals that plugins compute: which plugin, and what it is to do."""

from __future__ import annotations

from pydantic import Field

from wayside.api.base import Model
from wayside.api.freedata import FreeData
from wayside.api.source import PluginName


class SignalPlugin(Model):
    """A plugin that computes a signal, and its parameters."""

    name: PluginName = Field(
        description="The plugin: unmatched-objects, or the name of a wayside.signals entry point of an installed "
        "package."
    )
    parameters: FreeData = Field(
        default_factory=dict,
        description="The parameters of the plugin; see its documentation.",
    )
