"""Defines an action: a class with typed parameters that receives the episodes of a rule, one after the other.

An action has a separate thread: it may wait for disks and networks without delaying anything else. An exception ends
its work for that episode and no other.
"""

from __future__ import annotations

import threading
from abc import ABC
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Generic, Protocol, TypeVar

from pydantic import BaseModel

from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome
from detector.engine.samples.sample import Decoder
from detector.streams.codecs.ros import RosTypes
from wayside.api import Detector, EventRule
from wayside.api.base import Model
from wayside.api.validation_errors import FieldPath

P = TypeVar("P", bound=BaseModel)
"""The model of an action's parameters."""


class ActionParameters(Model):
    """Base of the parameters of an action from another package: camelCase in YAML; unknown fields are errors."""


class ActionError(Exception):
    """Raised by an action that cannot do its work for an episode; the message is shown to users."""


class Messenger(Protocol):
    """The part of the detector's Zenoh session that actions use. Thread-safe."""

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        """Queue a message; never waits. If the queue is full, the message is dropped and counted."""

    def query(
        self, selector: str, payload: bytes | None, timeout: float, attachment: bytes | None = None
    ) -> list[bytes]:
        """Send a query to all that can answer it, and wait at most `timeout` seconds for the answers.

        Raises ActionError if there is no session, no answer, or an error as the answer.
        """


@dataclass(frozen=True, slots=True)
class DetectorConfiguration:
    """The current configuration of the detector. It may differ after a change of the Detector."""

    detector: Detector
    decoders: Mapping[str, Decoder]
    """By stream."""
    types: RosTypes
    """The ROS 2 message types that the Detector knows."""


@dataclass(frozen=True, slots=True)
class ActionContext:
    """The context of an action. All of it is thread-safe."""

    rule: EventRule
    action: str
    """The action's name in the rule."""
    holder: str
    configuration: Callable[[], DetectorConfiguration]
    messenger: Messenger
    report: Callable[[Episode, Outcome], None]
    """Report the progress of an episode: it is published, counted and shown by `detector status`.

    Every started episode must finally be reported DONE or FAILED, and may be reported RUNNING before, also repeatedly.
    """
    lose: Callable[[str, int, str], None]
    """Count losses: a short description, the number, and the reason. They are shown with the losses of the detector."""
    closing: threading.Event
    """Set when the detector stops: waiting code should give up soon."""


class Action(ABC, Generic[P]):
    """An action of a rule.

    There is one object for each action of each rule. All its methods are called on one separate thread, never two at a
    time, and for each episode in this order: `started`, `samples` and `ended` as they happen, `completed` last.
    Episodes overlap.

    An exception in `started`, `samples`, `ended` or `completed` is reported as the failure of that episode, which then
    receives no further calls.
    """

    Parameters: ClassVar[type[BaseModel]]
    """The model of its parameters; `detector check` reports errors with their place."""

    @classmethod
    def problems(cls, parameters: P, detector: Detector) -> Iterable[tuple[FieldPath, str]]:
        """Problems of the parameters that their model cannot detect, each with its place among them.

        `detector check` reports it, and a rule with such an action is refused.
        """
        return ()

    def __init__(self, parameters: P, context: ActionContext) -> None:
        self.parameters = parameters
        self.context = context

    def started(self, episode: Episode) -> None:
        """An episode began, or was restored after a restart (`episode.resumed`)."""

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        """The next samples of its window: in time order per client and stream, except for late ones."""

    def ended(self, episode: Episode) -> None:
        """Its event ended; samples of the window's `after` may follow."""

    def completed(self, episode: Episode, completion: Completion) -> None:
        """No more samples or events follow. The episode may still be open if the detector or the action ends."""

    def wake(self) -> float | None:
        """Called between the other methods: run due work, and return the maximum number of seconds until the next call.

        None: not before new input. Exceptions are counted, and it is called again after a second.
        """
        return None

    def close(self) -> None:
        """The last call: all episodes are completed. Give up after a few seconds if something hangs."""
