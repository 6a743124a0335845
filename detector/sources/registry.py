"""Which plugins are installed, and whether a Detector gives them what they ask for."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pydantic import BaseModel, ValidationError

from detector.sources.base import Source
from wayside.api import Detector
from wayside.api.source import DataSource
from wayside.api.wording import FieldPath, messages
from wayside.rules import RuleProblem

GROUP = "wayside.sources"

Make = Callable[[], Source[Any]]
"""Makes a source for one run."""


class PluginError(ValueError):
    """A plugin that is not there, cannot be loaded, or refuses its parameters; `problems` says where and why.

    The paths begin at the entry in `spec.sources`.
    """

    def __init__(self, *problems: tuple[FieldPath, str]) -> None:
        self.problems = problems
        super().__init__("; ".join(text for _, text in problems))


def installed() -> dict[str, EntryPoint]:
    """The plugins by name; of two with the same name, the one found first."""
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=GROUP):
        found.setdefault(entry.name, entry)
    return dict(sorted(found.items()))


def prepare(source: DataSource) -> Make:
    """Loads the plugin and checks its parameters. Raises PluginError."""
    plugin = _load(source.plugin)
    try:
        parameters = plugin.Parameters.model_validate(source.parameters)
    except ValidationError as error:
        raise PluginError(
            *((("parameters", *path), text) for path, text in messages(error, source.parameters))
        ) from error
    return lambda: plugin(parameters)


def plugin_problems(detector: Detector) -> Iterator[RuleProblem]:
    """What is wrong with the Detector's sources, as far as their plugins can tell here."""
    for index, source in enumerate(detector.spec.sources):
        try:
            prepare(source)
        except PluginError as error:
            for path, text in error.problems:
                yield RuleProblem(("spec", "sources", index, *path), text)


@cache
def _load(name: str) -> type[Source[Any]]:
    """Raises PluginError; then nothing is remembered."""
    entries = installed()
    entry = entries.get(name)
    if entry is None:
        close = difflib.get_close_matches(name, entries, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(entries) or 'none'}"
        raise PluginError((("plugin",), f"no plugin {name} is installed; {hint}; see docs/sources.md"))
    try:
        plugin = entry.load()
    except ImportError as error:
        extra = f"install its extra, e.g. wayside[{name}]"
        raise PluginError((("plugin",), f"plugin {name} cannot be loaded: {error}: {extra}")) from error
    except Exception as error:  # somebody else's module, which may raise whatever it likes
        raise PluginError((("plugin",), f"plugin {name} cannot be loaded: {type(error).__name__}: {error}")) from error
    if not (inspect.isclass(plugin) and issubclass(plugin, Source)):
        raise PluginError((("plugin",), f"plugin {name} is {entry.value}, which is no detector.sources.Source"))
    model = getattr(plugin, "Parameters", None)
    if not (inspect.isclass(model) and issubclass(model, BaseModel)):
        raise PluginError((("plugin",), f"plugin {name} has no Parameters: give {entry.value} a pydantic model"))
    return plugin
