"""Plugins of sources, signals and actions, and their parameters."""

from __future__ import annotations

from pydantic import Field

from wayside.api.actions.window import Window
from wayside.api.base import Model, ObjectName
from wayside.api.freedata import FreeData, NamedData

ZENOH = "zenoh"
"""The default source of a stream: the session of `spec.zenoh`."""


class DataSource(Model):
    """A plugin that receives samples, and its parameters."""

    name: ObjectName
    """The name by which streams refer to the source."""
    plugin: ObjectName
    """The name of the plugin: mqtt, bag, or an entry point of the group wayside.sources in an installed package."""
    parameters: FreeData = Field(default_factory=dict)
    """The parameters of the plugin; see its documentation."""


class SignalPlugin(Model):
    """A plugin that computes a signal, and its parameters."""

    name: ObjectName
    """The name of the plugin: unmatched-objects, or an entry point of the group wayside.signals in an installed
    package."""
    parameters: FreeData = Field(default_factory=dict)
    """The parameters of the plugin; see its documentation."""


class ActionPlugin(Model):
    """An action of an installed package, and its parameters."""

    name: ObjectName
    """The name of the plugin: an entry point of the group wayside.actions in an installed package."""
    parameters: FreeData = Field(default_factory=dict)
    """The parameters of the plugin; see its documentation."""
    values: NamedData = Field(default_factory=dict)
    """Values that the plugin receives for each episode. They can contain ${…} with the rule's variables at the start of
    the episode."""
    window: Window | None = None
    """The samples that the plugin receives. Default: none."""
