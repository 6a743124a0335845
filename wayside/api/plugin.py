"""Plugins of signals and of actions, and their parameters."""

from __future__ import annotations

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import Model
from wayside.api.freedata import FreeData, NamedData
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


class ActionPlugin(Model):
    """An action of an installed package, and its parameters."""

    name: PluginName = Field(
        description="The plugin: the name of a wayside.actions entry point of an installed package."
    )
    parameters: FreeData = Field(
        default_factory=dict,
        description="The parameters of the plugin; see its documentation.",
    )
    values: NamedData = Field(
        default_factory=dict,
        description="Values that the plugin receives for each episode, with ${…} over the rule's variables at the "
        "start of the episode.",
    )
    window: Window | None = Field(default=None, description="The samples that the plugin receives. Default: none.")
