"""Defines a plugin: a class with typed parameters and one method, with one object per subject."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, ClassVar, Generic, NamedTuple, TypeVar

from pydantic import AfterValidator, Field, ValidationInfo

from detector.engine.queries.queries import Queries
from wayside.api.base import Model
from wayside.expressions import Value
from wayside.names import did_you_mean

P = TypeVar("P", bound="PluginParameters")
"""The model of a plugin's parameters."""


class PluginParameters(Model):
    """Base of a plugin's parameters: camelCase in YAML, immutable; unknown fields are errors."""


def _known_stream(name: str, info: ValidationInfo) -> str:
    streams: list[str] | None = (info.context or {}).get("streams")
    if streams is None or name in streams:
        return name
    hint = did_you_mean(name, streams) or f"its streams are {', '.join(streams)}"
    raise ValueError(f"the Detector has no stream {name}; {hint}")


StreamName = Annotated[str, Field(min_length=1, max_length=63), AfterValidator(_known_stream)]
"""A parameter that names a stream: `detector check` rejects one that the Detector does not have."""

Seconds = Annotated[float, Field(ge=0, le=86_400)]
"""A parameter that is a duration in seconds."""


class PluginSubject(NamedTuple):
    """The subject for which a plugin's object computes its signal."""

    text: str
    """The text in events: `car1`, `car1+car2`, `~fleet`, followed by `~` and the element of `each` if there is one."""
    element: str | None
    """The name of the element of `each`."""


class Plugin(ABC, Generic[P]):
    """Computes a signal. Each subject of the rule has a separate object, whose attributes are its state.

    The object is created when the subject is first evaluated, and dropped when the rule is no longer evaluated for it,
    when the rule changes, and when time jumps. Its results must depend only on its parameters, its state and the
    queries (no clock, no random numbers): then a replay gives the same results as the drive.
    """

    Parameters: ClassVar[type[PluginParameters]]
    """The model of `signals[].plugin.parameters`; `detector check` reports invalid ones with their place."""

    def __init__(self, parameters: P, subject: PluginSubject) -> None:
        self.parameters = parameters
        self.subject = subject

    @classmethod
    def warm_up(cls) -> None:
        """Called once before any other call, in the process of the plugin: put slow loading here.

        A value must be returned within half a second, including its imports.
        """

    @abstractmethod
    def value(self, queries: Queries, clients: tuple[str, ...]) -> Value:
        """The signal at this evaluation: a boolean, number, text, list or map of these; None if it is unknown.

        Args:
            queries: the buffer at the tick. Messages are shared: do not modify them.
            clients: the client; the two of a pair; the fleet's members at this tick.

        Any exception makes the signal unknown for this evaluation; it is counted and reported.
        """
