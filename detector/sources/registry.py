"""Finds the class of a source, and validates its parameters; loads no threads, so that `detector check` starts fast."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from pydantic import BaseModel

from detector.plugins.entrypoints import PluginClasses, PluginError
from detector.sources.base import Source
from wayside.api import Detector
from wayside.api.plugin import DataSource
from wayside.rules import RuleProblem

OFFERS = PluginClasses[Source[Any]](
    group="wayside.sources", noun="plugin", base=Source, model=BaseModel, guide="docs/sources.md"
)

Make = Callable[[], Source[Any]]
"""Creates a source for one run."""


def prepare_source(source: DataSource) -> Make:
    """Loads the plugin and checks its parameters.

    Raises PluginError; the paths begin at the entry in `spec.sources`.
    """
    plugin = OFFERS.load(source.plugin, ("plugin",))
    parameters = OFFERS.parameters(plugin, source.parameters, ("parameters",))
    return lambda: plugin(parameters)


def source_plugin_problems(detector: Detector) -> Iterator[RuleProblem]:
    """The problems of the Detector's sources, as far as their plugins can check here."""
    for index, source in enumerate(detector.spec.sources):
        try:
            prepare_source(source)
        except PluginError as error:
            for path, text in error.problems:
                yield RuleProblem(("spec", "sources", index, *path), text)
