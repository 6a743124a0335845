"""What a plugin is: a class with typed parameters and one method, of which every subject has an object of its own."""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from typing import Annotated, ClassVar, Generic, NamedTuple, TypeVar

from pydantic import AfterValidator, Field, ValidationInfo

from detector.engine.queries.queries import Queries
from wayside.api.base import Model
from wayside.expressions import Value

P = TypeVar("P", bound="PluginParameters")
"""The model of a plugin's parameters."""


class PluginParameters(Model):
    """Base of a plugin's parameters: camelCase in YAML, immutable, and a misspelt field is an error."""


def _known_stream(name: str, info: ValidationInfo) -> str:
    streams: list[str] | None = (info.context or {}).get("streams")
    if streams is None or name in streams:
        return name
    close = difflib.get_close_matches(name, streams, n=1)
    hint = f"did you mean {close[0]}?" if close else f"its streams are {', '.join(streams)}"
    raise ValueError(f"the Detector has no stream {name}; {hint}")


StreamName = Annotated[str, Field(min_length=1, max_length=63), AfterValidator(_known_stream)]
"""A parameter that names a stream: `detector check` refuses one that the Detector does not have."""

Seconds = Annotated[float, Field(ge=0, le=86_400)]
"""A parameter that is a length of time in seconds."""


class Subject(NamedTuple):
    """Whom a plugin's object computes its signal for."""

    text: str
    """As in events: `car1`, `car1+car2`, `~fleet`, followed by `~` and the element of `each` where there is one."""
    element: str | None
    """The name of the element of `each`."""


class Plugin(ABC, Generic[P]):
    """Computes a signal. Each subject of the rule has an object of its own, whose attributes are its state.

    The object is made when the subject is first evaluated, and dropped when the rule is no longer evaluated for it,
    when the rule changes, and when time jumps. What it computes must follow from its parameters, its state and the
    queries alone (no clock, no random numbers): then a replay gives what the drive gave.
    """

    Parameters: ClassVar[type[PluginParameters]]
    """The model of `signals[].plugin.parameters`; what it refuses, `detector check` reports with its place."""

    def __init__(self, parameters: P, subject: Subject) -> None:
        self.parameters = parameters
        self.subject = subject

    @classmethod
    def warm_up(cls) -> None:
        """Called once where the plugin runs, before any other call: slow loading belongs here.

        A value must be there within half a second, and that includes what is imported for it.
        """

    @abstractmethod
    def value(self, queries: Queries, clients: tuple[str, ...]) -> Value:
        """The signal at this evaluation: a boolean, number, text, list or map of these; None where it is unknown.

        Args:
            queries: the buffer as it is at the tick. Messages are shared: look, do not change.
            clients: the client; the two of a pair; the fleet's members at this tick.

        Whatever it raises makes the signal unknown for this evaluation; it is counted and reported.
        """
