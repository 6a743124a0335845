"""The detector's place in the Zenoh network: samples come in, events go out.

Each stream has a thread that does nothing but hand key and bytes of its samples to the intake, so that the vehicle is
never slowed. It takes them from a channel and not by a callback: a burst is taken in one go, where callbacks would pass
the interpreter's lock on for every message (`benchmarks/intake_rate.py`). Events wait in a bounded queue for a thread
of their own, so that the network never slows the evaluation.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable

import zenoh

from detector.engine.samples.liveliness import LIVELINESS
from detector.streams.answering import Answering
from detector.streams.bursts import Put
from detector.streams.layouts import Pump, pump_for
from detector.streams.liveliness import TokenWatch
from detector.streams.session import Connections, NetworkError, await_session, open_session
from detector.streams.subscribing import Subscription, subscribe
from detector.streams.tally import Tally
from wayside.api.stream import Stream
from wayside.api.zenoh import Zenoh, ZenohMode

log = logging.getLogger(__name__)

__all__ = ["EVENT_ENCODING", "Network", "NetworkError", "Put", "open_session"]

EVENT_ENCODING = "application/cloudevents+json"
_CHANNEL = 16_384
"""So many samples of a stream wait for its thread while the evaluation holds the interpreter's lock. Once they are full
Zenoh's own queues fill, and then it is the sender's congestion control that says whether it waits or drops."""


class Network:
    """One session: subscribed to all streams, and the way out for events."""

    def __init__(
        self,
        config: Zenoh,
        streams: Iterable[Stream],
        putter: Callable[[str], Put],
        *,
        capacity: int = 4096,
        on_failure: Callable[[BaseException], None] = lambda error: None,
        answering: Callable[[zenoh.Session], Answering] | None = None,
        tally: Tally | None = None,
    ) -> None:
        """`putter` gives what takes a stream's messages; at most `capacity` events wait to be published.

        `answering` answers queries once there is a session. What was lost before the detector goes into the `tally`.
        `on_failure` is told if a thread dies of an error.
        """
        self._on_failure = on_failure
        self._config = config
        self._tally = Tally() if tally is None else tally
        self._streams = [(stream, pump_for(stream, putter(stream.name), self._tally)) for stream in streams]
        self._liveliness = config.liveliness
        self._put_token = putter(LIVELINESS)
        self._tokens: TokenWatch | None = None
        self._capacity = capacity
        self._events: deque[tuple[str, bytes, str]] = deque()
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._session: zenoh.Session | None = None
        self._connections: Connections | None = None
        self._receivers: list[threading.Thread] = []
        self._make_answering = answering
        self._answering: Answering | None = None
        self._thread = threading.Thread(target=self._run, name="network", daemon=True)
        self.dropped_events = 0
        """Events that found the queue full, or that Zenoh refused."""

    def start(self) -> None:
        """Opens the session: a client's in the background until it succeeds, else at once (raises NetworkError)."""
        if self._config.mode is not ZenohMode.CLIENT:
            self._join(open_session(self._config))
        self._thread.start()

    def publish(self, key: str, payload: bytes, encoding: str = EVENT_ENCODING) -> None:
        """Queues an event, or what an action tells; never waits. With the queue full it is dropped and counted."""
        with self._changed:
            if len(self._events) >= self._capacity or self._stop.is_set():
                self.dropped_events += 1
                return
            self._events.append((key, payload, encoding))
            self._changed.notify()

    def ask(self, selector: str, payload: bytes | None, timeout: float, attachment: bytes | None = None) -> list[bytes]:
        """Sends a query to all who answer it, and waits for their answers, at most so many seconds.

        Raises NetworkError where there is no session, nobody answers in time, or an answer is an error.
        """
        session = self._session
        if session is None:
            raise NetworkError("there is no Zenoh session yet")
        try:
            replies = session.get(
                selector, payload=payload, attachment=attachment, timeout=timeout, target=zenoh.QueryTarget.ALL
            )
            answers, errors = [], []
            for reply in replies:
                if reply.ok is not None:
                    answers.append(reply.ok.payload.to_bytes())
                elif reply.err is not None:
                    errors.append(reply.err.payload.to_bytes().decode(errors="replace"))
        except zenoh.ZError as error:
            raise NetworkError(f"{selector}: {error}") from error
        if errors:
            raise NetworkError(f"{selector}: {errors[0]}")
        if not answers:
            raise NetworkError(f"{selector}: nobody answered within {timeout:g} s")
        return answers

    @property
    def joined(self) -> bool:
        """Whether there is a session: samples come in as soon as somebody is connected."""
        return self._session is not None

    @property
    def connected(self) -> bool:
        """Whether a router, a peer or a client is connected right now."""
        connections = self._connections
        return connections is not None and connections.any

    def close(self, timeout: float = 2.0) -> None:
        """Publishes what still waits, for at most `timeout` seconds, and leaves the network."""
        with self._changed:
            self._stop.set()
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(timeout)
        if (session := self._session) is not None:
            self._session = None
            if self._connections is not None:
                self._connections.close()
                self._connections = None
            session.close()  # type: ignore[no-untyped-call]  # frees the threads: of a put that waits, and of receiving
        for receiver in self._receivers:
            receiver.join(timeout)
        if self._tokens is not None:
            self._tokens.close(timeout)
        if self._answering is not None:
            self._answering.join(timeout)
        if (left := len(self._events)) > 0:
            self.dropped_events += left
            log.warning("%d events were not published: the network did not take them within %g s", left, timeout)

    def _join(self, session: zenoh.Session) -> None:
        self._connections = Connections(session)
        for stream, pump in self._streams:
            subscription = subscribe(session, stream, _CHANNEL, self._tally)
            name = f"stream {stream.name}"
            thread = threading.Thread(target=self._receive, args=(subscription, pump), name=name, daemon=True)
            thread.start()
            self._receivers.append(thread)
        if self._liveliness is not None:
            self._tokens = TokenWatch(session, self._connections, self._liveliness, self._put_token)
        self._session = session
        if self._make_answering is not None:
            self._answering = self._make_answering(session)

    def _receive(self, subscription: Subscription, pump: Pump) -> None:
        """Hands over what comes on a stream, until the session is closed."""
        try:
            pump(subscription.handler)
        except Exception as error:  # noqa: BLE001  this thread's edge: without it, the stream would be silent for ever
            if not self._stop.is_set():
                log.critical("a stream's thread ended, nothing is received on it any more: %s", error)
                self._on_failure(error)

    def _run(self) -> None:
        try:
            self._serve()
        except Exception as error:  # noqa: BLE001  this thread's edge: without it, events would wait for ever
            log.critical("the network thread ended, no event is published any more: %s", error)
            self._on_failure(error)

    def _serve(self) -> None:
        if self._session is None:
            session = await_session(self._config, self._stop)
            if session is None:
                return
            self._join(session)
        while (event := self._next()) is not None:
            self._send(*event)

    def _next(self) -> tuple[str, bytes, str] | None:
        """The next event; None once closing and nothing waits."""
        with self._changed:
            self._changed.wait_for(lambda: self._events or self._stop.is_set())
            return self._events.popleft() if self._events else None

    def _send(self, key: str, payload: bytes, encoding: str) -> None:
        if (session := self._session) is None:  # closed meanwhile, the time for what still waited being over
            self.dropped_events += 1
            return
        try:
            # BLOCK: events are few and should survive a short congestion; only this thread waits for it.
            session.put(
                key,
                payload,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=True,
            )
        except zenoh.ZError as error:
            self.dropped_events += 1
            log.warning("event on %s was not published: %s", key, error)
