"""What a source is: a class with typed parameters and one method that delivers messages until it is to stop."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Generic, Protocol, TypeVar

from pydantic import BaseModel

from wayside.api.stream import Stream
from wayside.keys import KeyPattern

P = TypeVar("P", bound=BaseModel)
"""The model of a source's parameters."""

Put = Callable[[Sequence[tuple[str, bytes]]], None]
"""Takes messages that came together: the key and the payload of each. Thread-safe, and never waits."""


class Putter(Protocol):
    """Gives what takes the messages of some streams: each message goes to all of them, at one time."""

    def __call__(self, *streams: str) -> Put:
        """`streams` are their names."""


_MAXIMUM_KEYS = 100_000
"""So many keys' streams are remembered; beyond, they are looked up anew."""


class SourceError(Exception):
    """Raised by a source that cannot go on now, with a text for people. It is started again after a pause."""


@dataclass(frozen=True, slots=True)
class FedStream:
    """A stream of the source."""

    spec: Stream
    pattern: KeyPattern
    """Which keys belong to it; its `expression` is the key with the captures replaced by their wildcards."""


class Feed:
    """One run's way to the detector: the streams to deliver, where to put messages, and whether to stop."""

    def __init__(self, streams: Sequence[Stream], putter: Putter, on_unrouted: Callable[[str], None]) -> None:
        """`putter` gives what takes the messages of the streams of these names; `on_unrouted` gets each key that
        belongs to no stream."""
        self.streams = tuple(FedStream(stream, KeyPattern.parse(stream.key)) for stream in streams)
        """The streams that name this source, in the Detector's order."""
        self._puts = {stream.name: putter(stream.name) for stream in streams}
        self._putter = putter
        self._routes: dict[str, Put] = {}
        self._on_unrouted = on_unrouted
        self._stop = threading.Event()
        self.messages = 0
        """How many messages were delivered."""

    def put(self, key: str, payload: bytes) -> None:
        """Deliver a message to every stream that its key belongs to, at one time; never waits, thread-safe.

        One that belongs to none is dropped and counted. After the stop nothing is taken any more.
        """
        if self._stop.is_set():
            return
        put = self._routes.get(key) or self._route(key)
        if put is None:
            self._on_unrouted(key)
            return
        put([(key, payload)])
        self.messages += 1

    def deliver(self, stream: str, key: str, payload: bytes) -> None:
        """Deliver a message to one stream of the source. Raises KeyError if it is none."""
        put = self._puts[stream]
        if not self._stop.is_set():
            put([(key, payload)])
            self.messages += 1

    @property
    def stopping(self) -> bool:
        """Whether `run` is to return."""
        return self._stop.is_set()

    def wait(self, seconds: float) -> bool:
        """Sleep, at most until `run` is to return; whether it is."""
        return self._stop.wait(seconds)

    def stop(self) -> None:
        """For the detector: `run` is to return."""
        self._stop.set()

    def _route(self, key: str) -> Put | None:
        """What takes the messages of the key; None where it belongs to no stream."""
        streams = [each.spec.name for each in self.streams if each.pattern.match(key) is not None]
        if not streams:
            return None
        if len(self._routes) >= _MAXIMUM_KEYS:
            self._routes.clear()
        put = self._routes[key] = self._putter(*streams)
        return put


class Source(ABC, Generic[P]):
    """Brings messages from somewhere.

    The detector makes a new one for every run, on a thread that belongs to it alone.
    """

    Parameters: ClassVar[type[BaseModel]]
    """The model of `spec.sources[].parameters`; what it refuses, `detector check` reports."""

    def __init__(self, parameters: P) -> None:
        self.parameters = parameters

    @abstractmethod
    def run(self, feed: Feed) -> None:
        """Deliver messages to the feed until `feed.stopping`, looking at it at least once a second.

        Whatever it raises is logged and counted, and it is run again after a pause (0.5 s, doubling up to 30 s).
        Returning without being told to stop says that there is nothing more to come.
        """
