"""Which plugins there are, and whether a rule gives them what they ask for."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pydantic import ValidationError

from detector.plugins.base import Plugin, PluginParameters
from wayside.api import Detector, EventRule
from wayside.api.wording import FieldPath, messages
from wayside.rules import RuleProblem

GROUP = "wayside.signals"

_SHIPPED = (EntryPoint("unmatched-objects", "detector.plugins.unmatched:UnmatchedObjects", GROUP),)


class PluginError(ValueError):
    """A plugin that is not there, cannot be loaded, or refuses its parameters; `problems` says where and why.

    The paths begin at the signal's `plugin`.
    """

    def __init__(self, *problems: tuple[FieldPath, str]) -> None:
        self.problems = problems
        super().__init__("; ".join(text for _, text in problems))


def installed() -> dict[str, EntryPoint]:
    """The plugins by name; of two with the same name, the shipped one, or the one found first."""
    found: dict[str, EntryPoint] = {}
    for entry in (*_SHIPPED, *entry_points(group=GROUP)):
        found.setdefault(entry.name, entry)
    return dict(sorted(found.items()))


def prepare(
    name: str, parameters: Mapping[str, Any], streams: list[str] | None = None
) -> tuple[type[Plugin[Any]], PluginParameters]:
    """The plugin and its parameters; `streams` are those that parameters may name. Raises PluginError."""
    plugin = _load(name)
    try:
        return plugin, plugin.Parameters.model_validate(dict(parameters), context={"streams": streams})
    except ValidationError as error:
        raise PluginError(
            *((("parameters", *path), text) for path, text in messages(error, dict(parameters)))
        ) from error


def plugin_problems(rule: EventRule, detector: Detector) -> Iterator[RuleProblem]:
    """What is wrong with the plugins of a rule's signals."""
    streams = [stream.name for stream in detector.spec.streams]
    for index, signal in enumerate(rule.spec.signals):
        if signal.plugin is not None:
            try:
                prepare(signal.plugin.name, signal.plugin.parameters, streams)
            except PluginError as error:
                for path, text in error.problems:
                    yield RuleProblem(("spec", "signals", index, "plugin", *path), text)


@cache
def _load(name: str) -> type[Plugin[Any]]:
    """Raises PluginError; then nothing is remembered."""
    entries = installed()
    entry = entries.get(name)
    if entry is None:
        close = difflib.get_close_matches(name, entries, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(entries)}"
        raise PluginError((("name",), f"no plugin {name} is installed here; {hint} (docs/plugins.md)"))
    try:
        plugin = entry.load()
    except Exception as error:  # somebody else's module, which may raise whatever it likes
        raise PluginError((("name",), f"plugin {name} cannot be loaded: {type(error).__name__}: {error}")) from error
    if not (inspect.isclass(plugin) and issubclass(plugin, Plugin) and not inspect.isabstract(plugin)):
        raise PluginError((("name",), f"plugin {name} is {entry.value}, which is no complete detector.plugins.Plugin"))
    model = getattr(plugin, "Parameters", None)
    if not (inspect.isclass(model) and issubclass(model, PluginParameters)):
        raise PluginError((("name",), f"plugin {name}: give {entry.value} a class Parameters(PluginParameters)"))
    return plugin
