"""One session of the detector, with everything declared on it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import zenoh

from detector.access.credentials import Material
from detector.streams.answering import Answering
from detector.streams.liveliness import subscribe_tokens
from detector.streams.session import Connections
from detector.streams.subscribing import Subscription, subscribe
from detector.streams.tally import Tally
from wayside.api.stream import Stream

_CHANNEL = 16_384
"""Maximum number of samples of a stream that wait for its thread while the evaluation holds the interpreter's lock.
Once it is full, Zenoh's own queues fill, and then the sender's congestion control decides whether it waits or drops."""

_PATIENCE = 10.0
"""Seconds for which a session is kept that is no longer needed, but on which a response is awaited."""


class Membership:
    """Subscribed to all streams and to the clients' tokens. `subscriptions` queue samples, in the streams' order."""

    def __init__(
        self, session: zenoh.Session, material: Material, streams: Sequence[Stream], tokens: str | None, tally: Tally
    ) -> None:
        """`tokens`: their key. Raises KeyPatternError, zenoh.ZError."""
        self.session = session
        self.material = material
        self.connections = Connections(session)
        self.subscriptions: list[Subscription] = [subscribe(session, stream, _CHANNEL, tally) for stream in streams]
        self.tokens = None if tokens is None else subscribe_tokens(session, tokens)
        self._answering: Answering | None = None
        self._users = 0
        self._unused = threading.Condition()

    def answer(self, answering: Callable[[zenoh.Session], Answering]) -> None:
        """Handle queries on this session from now on."""
        self._answering = answering(self.session)

    @contextmanager
    def used(self) -> Iterator[zenoh.Session]:
        """The session, which stays open until the context ends, unless it is closed for good."""
        with self._unused:
            self._users += 1
        try:
            yield self.session
        finally:
            with self._unused:
                self._users -= 1
                self._unused.notify_all()

    def retire(self) -> None:
        """Close once it is no longer used, and after ten seconds in any case."""
        with self._unused:
            self._unused.wait_for(lambda: not self._users, _PATIENCE)
        self.close()

    def close(self, timeout: float = 2.0) -> None:
        """Leave at once; this unblocks the threads that wait to receive or to send."""
        self.connections.close()
        self.session.close()  # type: ignore[no-untyped-call]
        if self._answering is not None:
            self._answering.join(timeout)

    def await_connection(self, stop: threading.Event, seconds: float) -> bool:
        """Whether a connection exists within `seconds`."""
        until = time.monotonic() + seconds
        while not self.connections.any and time.monotonic() < until and not stop.wait(0.01):
            pass
        return self.connections.any
