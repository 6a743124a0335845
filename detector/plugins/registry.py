"""Finds the class of a plugin, and validates its parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint
from typing import Any

from detector.plugins.base import Plugin, PluginParameters
from detector.plugins.entrypoints import Offers, PluginError
from wayside.api import Detector, EventRule
from wayside.rules import RuleProblem

_GROUP = "wayside.signals"

OFFERS = Offers[Plugin[Any]](
    group=_GROUP,
    noun="plugin",
    base=Plugin,
    model=PluginParameters,
    guide="docs/plugins.md",
    shipped=(EntryPoint("unmatched-objects", "detector.plugins.unmatched:UnmatchedObjects", _GROUP),),
)


def prepare_plugin(
    name: str, parameters: Mapping[str, Any], streams: list[str] | None = None
) -> tuple[type[Plugin[Any]], PluginParameters]:
    """The plugin and its parameters; `streams` are those that parameters may name.

    Raises PluginError; the paths begin at the signal's `plugin`.
    """
    plugin = OFFERS.load(name, ("name",))
    return plugin, OFFERS.parameters(plugin, parameters, ("parameters",), {"streams": streams})


def plugin_problems(rule: EventRule, detector: Detector) -> Iterator[RuleProblem]:
    """The problems of the plugins in a rule's signals."""
    streams = [stream.name for stream in detector.spec.streams]
    for index, signal in enumerate(rule.spec.signals):
        if signal.plugin is not None:
            try:
                prepare_plugin(signal.plugin.name, signal.plugin.parameters, streams)
            except PluginError as error:
                for path, text in error.problems:
                    yield RuleProblem(("spec", "signals", index, "plugin", *path), text)
