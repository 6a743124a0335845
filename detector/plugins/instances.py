"""The class of a plugin, its objects for one signal, one per subject, and a host that calls them in this process."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from importlib.metadata import EntryPoint
from typing import Any

from detector.engine.queries.queries import Queries
from detector.engine.scoping.plugins import PluginCall, PluginFailedError
from detector.plugins.base import Plugin, PluginParameters, PluginSubject
from detector.plugins.entrypoints import PluginClasses, PluginError
from wayside.api import Detector, EventRule
from wayside.expressions import Reason, Value
from wayside.expressions.numbers import as_double
from wayside.rules import CompiledRule, RuleProblem

_GROUP = "wayside.signals"

OFFERS = PluginClasses[Plugin[Any]](
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


class Instances:
    """The objects of one signal."""

    def __init__(self, plugin: str, parameters: Mapping[str, Any]) -> None:
        """Raises PluginError, and the exceptions of the plugin's `warm_up`."""
        self._plugin, self._parameters = prepare_plugin(plugin, parameters)
        self._plugin.warm_up()
        self._objects: dict[str, Plugin[Any]] = {}

    def value(self, subject: PluginSubject, clients: tuple[str, ...], queries: Queries) -> Value:
        """The signal's value. Raises the plugin's exceptions, and TypeError if its value is not plain data."""
        found = self._objects.get(subject.text)
        if found is None:
            found = self._objects[subject.text] = self._plugin(self._parameters, subject)
        return plain_value(found.value(queries, clients))

    def retain(self, subjects: Collection[str]) -> None:
        """Drop the objects of all other subjects."""
        for subject in [each for each in self._objects if each not in subjects]:
            del self._objects[subject]

    def reset(self) -> None:
        """Drop all objects."""
        self._objects.clear()

    def __len__(self) -> int:
        return len(self._objects)


def failure_text(error: BaseException) -> str:
    """A plugin's exception in one line, with its place in the plugin's code."""
    place, trace = "", error.__traceback__
    while trace is not None:
        name = trace.tb_frame.f_code.co_filename
        if "/detector/plugins/" not in name or name.endswith("unmatched.py"):
            place = f" ({name.rsplit('/', 1)[-1]}:{trace.tb_lineno})"
        trace = trace.tb_next
    return f"{type(error).__name__}: {error}{place}"[:500]


class LocalHost:
    """Runs plugins in the detector's process: for tests and debuggers. A hanging plugin is not stopped."""

    def __init__(self) -> None:
        self._signals: dict[tuple[str, str], Instances] = {}

    def configure(self, rules: Sequence[CompiledRule], kept: Collection[str]) -> None:
        """See PluginHost."""
        self._signals = {
            place: self._signals[place]
            if place in self._signals and rule.name in kept
            else Instances(plugin.plugin, plugin.parameters)
            for rule in rules
            for plugin in rule.plugins
            if (place := (rule.name, plugin.name))
        }

    def value(self, call: PluginCall, queries: Queries) -> Value:
        """See PluginHost."""
        try:
            return self._signals[call.rule, call.signal].value(
                PluginSubject(call.subject, call.element), call.clients, queries
            )
        except Exception as error:  # a plugin may raise any exception
            raise PluginFailedError(Reason.ERROR, failure_text(error)) from error

    def retain(self, rule: str, subjects: Collection[str]) -> None:
        """See PluginHost."""
        for (of_rule, _), instances in self._signals.items():
            if of_rule == rule:
                instances.retain(subjects)

    def reset(self) -> None:
        """See PluginHost."""
        for instances in self._signals.values():
            instances.reset()


_DEEPEST = 32


def plain_value(value: Any, depth: int = _DEEPEST) -> Value:
    """The value with integers as doubles and tuples as lists; NaN becomes None, at any depth.

    Raises TypeError for other data, and for data nested too deeply.
    """
    match value:
        case None | bool() | str():
            return value
        case int():
            return as_double(int(value))
        case float():
            return None if math.isnan(value) else float(value)
        case list() | tuple() if depth:
            return [plain_value(item, depth - 1) for item in value]
        case dict() if depth and all(isinstance(key, str) for key in value):
            return {key: plain_value(item, depth - 1) for key, item in value.items()}
    if not depth:
        raise TypeError(f"the value is nested more than {_DEEPEST} levels deep")
    scalar = getattr(value, "item", None)  # numpy's numbers
    if scalar is not None and getattr(value, "shape", None) == ():
        return plain_value(scalar(), depth - 1)
    raise TypeError(
        f"the value is a {type(value).__name__}: return None, a boolean, a number, a string, or lists and maps (with "
        "string keys) of these"
    )
