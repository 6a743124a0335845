"""Defines a source: a class with typed parameters and one method that delivers messages until it must stop."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Generic, Protocol, TypeVar

from pydantic import BaseModel

from detector.engine.samples.intake import Put
from wayside.api.stream import Stream
from wayside.keys import KeyPattern

P = TypeVar("P", bound=BaseModel)
"""The model of a source's parameters."""


class Putter(Protocol):
    """Returns the function that receives the messages of some streams: each goes to all of them, with the same time."""

    def __call__(self, *streams: str) -> Put:
        """`streams` are their names."""


_MAXIMUM_KEYS = 100_000
"""Maximum number of keys whose routes are cached; beyond it, the cache is emptied."""


class SourceError(Exception):
    """Raised by a source that cannot continue; the message is shown to users. The source restarts after a pause."""


@dataclass(frozen=True, slots=True)
class FedStream:
    """A stream of the source."""

    spec: Stream
    pattern: KeyPattern
    """The keys that belong to it; its `expression` is the key with the captures replaced by their wildcards."""


class Feed:
    """Connects one run of a source to the detector: its streams, where to put messages, and whether to stop."""

    def __init__(self, streams: Sequence[Stream], putter: Putter, on_unrouted: Callable[[str], None]) -> None:
        """`putter` returns the function that receives the messages of named streams; `on_unrouted` is called with the
        key of each message that belongs to no stream."""
        self.streams = tuple(FedStream(stream, KeyPattern.parse(stream.key)) for stream in streams)
        """The streams that name this source, in the Detector's order."""
        self._puts = {stream.name: putter(stream.name) for stream in streams}
        self._putter = putter
        self._routes: dict[str, Put | None] = {}
        """The function that receives the messages of a key; None for a key that belongs to no stream."""
        self._on_unrouted = on_unrouted
        self._stop = threading.Event()
        self.messages = 0
        """Number of delivered messages."""

    def put(self, key: str, payload: bytes) -> None:
        """Deliver a message to every stream that its key belongs to, with the same time; never waits, thread-safe.

        A message that belongs to no stream is dropped and counted. After the stop, all messages are ignored.
        """
        if self._stop.is_set():
            return
        try:
            put = self._routes[key]
        except KeyError:
            put = self._route(key)
        if put is None:
            self._on_unrouted(key)
            return
        put([(key, payload)])
        self.messages += 1

    def deliver(self, stream: str, key: str, payload: bytes) -> None:
        """Deliver a message to one stream of the source. Raises KeyError if the source has no such stream."""
        put = self._puts[stream]
        if not self._stop.is_set():
            put([(key, payload)])
            self.messages += 1

    @property
    def stopping(self) -> bool:
        """Whether `run` must return."""
        return self._stop.is_set()

    def wait(self, seconds: float) -> bool:
        """Sleep until the time is over or `run` must return; returns whether it must."""
        return self._stop.wait(seconds)

    def stop(self) -> None:
        """Called by the detector: `run` must return."""
        self._stop.set()

    def _route(self, key: str) -> Put | None:
        """Find and cache the function that receives the messages of the key; None if the key belongs to no stream."""
        streams = [each.spec.name for each in self.streams if each.pattern.match(key) is not None]
        if len(self._routes) >= _MAXIMUM_KEYS:
            self._routes.clear()
        put = self._routes[key] = self._putter(*streams) if streams else None
        return put


class Source(ABC, Generic[P]):
    """Delivers messages from some origin.

    The detector creates a new object for every run, on a separate thread.
    """

    Parameters: ClassVar[type[BaseModel]]
    """The model of `spec.sources[].parameters`; `detector check` reports invalid ones."""

    def __init__(self, parameters: P) -> None:
        self.parameters = parameters

    @abstractmethod
    def run(self, feed: Feed) -> None:
        """Deliver messages to the feed until `feed.stopping`, which it checks at least once a second.

        An exception is logged and counted, and the source runs again after a pause (0.5 s, doubling up to 30 s).
        A source that returns before `feed.stopping` has no more messages and does not run again.
        """
