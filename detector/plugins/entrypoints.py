"""The classes of one kind that installed packages provide, each with a model of its parameters.

A package declares what it provides by an entry point; a resource names it and gives it parameters. Every problem is
reported with its field: an unknown name, a module that does not load, invalid parameters.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar, cast

from pydantic import BaseModel, ValidationError

from wayside.api.validation_errors import FieldPath, messages
from wayside.names import did_you_mean

T = TypeVar("T")
"""The base class of the provided classes."""

_OWN = "wayside"
"""The distribution whose classes take precedence over those of others with the same name."""


class PluginError(ValueError):
    """A plugin that does not exist, cannot be loaded, or rejects its parameters; `problems` has places and reasons.

    The paths begin at the part of the resource that names the plugin.
    """

    def __init__(self, *problems: tuple[FieldPath, str]) -> None:
        self.problems = problems
        super().__init__("; ".join(text for _, text in problems))


@dataclass(frozen=True)
class PluginClasses(Generic[T]):
    """The classes of one kind that packages provide. Loading runs their code: only named ones are loaded, once."""

    group: str
    """The group of the entry points, e.g. wayside.signals."""
    noun: str
    """The word for one of them in messages, e.g. plugin."""
    base: type
    """T: the base class; derived classes have an attribute `Parameters`."""
    model: type[BaseModel]
    """The base class of `Parameters`."""
    guide: str
    """The guide for writing one, e.g. docs/plugins.md."""
    shipped: tuple[EntryPoint, ...] = ()
    """Those that need no installed package."""

    def installed(self) -> dict[str, EntryPoint]:
        """By name; of two with the same name, the detector's own, or the first one found."""
        found: dict[str, EntryPoint] = {}
        for entry in (*self.shipped, *sorted(entry_points(group=self.group), key=_foreign)):
            found.setdefault(entry.name, entry)
        return dict(sorted(found.items()))

    def load(self, name: str, at: FieldPath) -> type[T]:
        """The class named in the field `at`. Raises PluginError; nothing is cached then."""
        try:
            found: type[T] = _load(self, name)
        except LookupError as error:
            raise PluginError((at, str(error))) from error.__cause__
        return found

    def parameters(
        self, loaded: type[T], given: Mapping[str, Any], at: FieldPath, context: Mapping[str, Any] | None = None
    ) -> Any:
        """An instance of the class's Parameters, from the value of the field `at`. Raises PluginError."""
        written = dict(given)
        try:
            return loaded.Parameters.model_validate(written, context=context)  # type: ignore[attr-defined]
        except ValidationError as error:
            raise PluginError(*(((*at, *path), text) for path, text in messages(error, written))) from error


def _foreign(entry: EntryPoint) -> bool:
    return entry.dist is None or entry.dist.name != _OWN


@cache
def _load(classes: PluginClasses[T], name: str) -> type[T]:
    """Raises LookupError, with a text for the user."""
    entries = classes.installed()
    entry = entries.get(name)
    what = f"{classes.noun} {name}"
    if entry is None:
        hint = did_you_mean(name, entries) or f"there are {', '.join(entries) or 'none'}"
        raise LookupError(f"no {what} is installed; {hint} ({classes.guide})")
    try:
        loaded: Any = entry.load()
    except Exception as error:  # a third-party module, which may raise anything
        raise LookupError(f"cannot load {what}: {type(error).__name__}: {error}{_remedy(entry, error)}") from error
    base = f"{classes.base.__module__}.{classes.base.__qualname__}"
    complete = inspect.isclass(loaded) and issubclass(loaded, classes.base) and not inspect.isabstract(loaded)
    if not complete:
        raise LookupError(f"{what} must be a complete subclass of {base}; got {entry.value} ({classes.guide})")
    model = getattr(loaded, "Parameters", None)
    if not (inspect.isclass(model) and issubclass(model, classes.model)):
        raise LookupError(f"{what}: give {entry.value} a class Parameters({classes.model.__name__}) ({classes.guide})")
    return cast("type[T]", loaded)


def _remedy(entry: EntryPoint, error: Exception) -> str:
    """What to install if one of the detector's own classes lacks a library."""
    if not isinstance(error, ImportError) or entry.dist is None or _foreign(entry):
        return ""
    extras = entry.dist.metadata.get_all("Provides-Extra") or []
    return f": pip install '{_OWN}[{entry.name}]'" if entry.name in extras else ""
