"""The detector's connection to the Zenoh network: samples in, events out.

Each stream has a thread that only passes key and bytes of its samples to the intake, so that the vehicle is never
slowed. It takes them from a channel and not by a callback: a burst is taken at once, while callbacks would pass on the
interpreter's lock for every message (`benchmarks/intake_rate.py`). Events wait in a bounded queue with a separate
thread, so that the network never slows the evaluation.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable

import zenoh

from detector.access import LoadedCredentials
from detector.engine.samples.intake import Put
from detector.engine.samples.liveliness import LIVELINESS
from detector.streams.liveliness import TokenWatch
from detector.streams.loss_counter import LossCounter
from detector.streams.query_handler import QueryHandler
from detector.streams.renewal import CHECK_EVERY, CertificateState, Renewal, SessionSubscriptions
from detector.streams.session import NetworkError, await_session, credentials_of, open_session
from detector.streams.stream_input import StreamInput
from detector.streams.subscribing import Pump, pump_for
from wayside.api.stream import Stream
from wayside.api.zenoh import Zenoh, ZenohMode

log = logging.getLogger(__name__)

__all__ = ["EVENT_ENCODING", "Network", "NetworkError", "open_session"]

EVENT_ENCODING = "application/cloudevents+json"


class Network:
    """Subscriptions to all streams, and the publisher of events: over one session, which new certificates replace."""

    def __init__(
        self,
        config: Zenoh,
        streams: Iterable[Stream],
        putter: Callable[[str], Put],
        *,
        capacity: int = 4096,
        on_failure: Callable[[BaseException], None] = lambda error: None,
        make_query_handler: Callable[[zenoh.Session], QueryHandler] | None = None,
        loss_counter: LossCounter | None = None,
        check_every: float = CHECK_EVERY,
    ) -> None:
        """`putter` returns the function that receives a stream's messages; at most `capacity` events are queued.

        `make_query_handler` is called with each session. `loss_counter` counts losses before the detector.
        `on_failure` is called if a thread dies of an error. Certificates are checked every `check_every` seconds.
        """
        self._on_failure = on_failure
        self._config = config
        self._loss_counter = LossCounter() if loss_counter is None else loss_counter
        self._streams = [*streams]
        self._pumps = [pump_for(stream, putter(stream.name), self._loss_counter) for stream in self._streams]
        self._put_token = putter(LIVELINESS)
        self._tokens: TokenWatch | None = None
        self._check_every = check_every
        self._renewal: Renewal | None = None
        self._capacity = capacity
        self._events: deque[tuple[str, bytes, str]] = deque()
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._subscriptions: SessionSubscriptions | None = None
        self._inputs: list[StreamInput] = []
        self._receivers: list[threading.Thread] = []
        self._make_query_handler = make_query_handler
        self._thread = threading.Thread(target=self._run, name="network", daemon=True)
        self.dropped_events = 0
        """Events dropped because the queue was full, or that Zenoh refused."""

    def start(self) -> None:
        """Opens the session: a client's in the background until it succeeds, else at once (raises NetworkError)."""
        if self._config.mode is not ZenohMode.CLIENT:
            credentials = credentials_of(self._config)
            self._begin(open_session(self._config, credentials), credentials)
        self._thread.start()

    def publish(self, key: str, payload: bytes, encoding: str = EVENT_ENCODING) -> None:
        """Enqueues an event or a message of an action; never waits. If the queue is full, it is dropped and counted."""
        with self._changed:
            if len(self._events) >= self._capacity or self._stop.is_set():
                self.dropped_events += 1
                return
            self._events.append((key, payload, encoding))
            self._changed.notify()

    def query(
        self, selector: str, payload: bytes | None, timeout: float, attachment: bytes | None = None
    ) -> list[bytes]:
        """Sends a query to all that can answer it, and waits at most `timeout` seconds for the answers.

        Raises NetworkError if there is no session, no answer in time, or an error as the answer.
        """
        subscriptions = self._subscriptions
        if subscriptions is None:
            raise NetworkError("there is no Zenoh session yet")
        try:
            with subscriptions.used() as session:
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
            raise NetworkError(f"{selector}: no response within {timeout:g} s")
        return answers

    @property
    def joined(self) -> bool:
        """Whether there is a session: samples arrive as soon as there is a connection."""
        return self._subscriptions is not None

    @property
    def connected(self) -> bool:
        """Whether a router, a peer or a client is currently connected."""
        subscriptions = self._subscriptions
        return subscriptions is not None and subscriptions.connections.any

    @property
    def listens(self) -> bool:
        """Whether others can connect to it, so that it need not connect itself."""
        return self._config.mode is not ZenohMode.CLIENT

    @property
    def certificate_state(self) -> CertificateState:
        """The state of the certificates in use."""
        renewal = self._renewal
        return CertificateState() if renewal is None else renewal.certificate_state

    @property
    def dead(self) -> str | None:
        """The part that has ended unexpectedly, so that no samples arrive any more; None if all parts are alive.

        A router that is unavailable does not count: the session reconnects.
        """
        if self._stop.is_set() or not self._thread.ident:
            return None
        ended = [each.name for each in (self._thread, *self._receivers) if not each.is_alive()]
        if self._tokens is not None and not self._tokens.alive:
            ended.append("liveliness")
        return f"the thread of {ended[0]} has ended" if ended else None

    def close(self, timeout: float = 2.0) -> None:
        """Publishes the queued events, for at most `timeout` seconds, and leaves the network."""
        if self._renewal is not None:
            self._renewal.stop()
        with self._changed:
            self._stop.set()
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(timeout)
        if self._renewal is not None:
            self._renewal.join(timeout)
        for stream_input in self._inputs:
            stream_input.close()
        if (subscriptions := self._subscriptions) is not None:
            self._subscriptions = None
            subscriptions.close(timeout)  # unblocks the threads that wait to put or to receive
        for receiver in self._receivers:
            receiver.join(timeout)
        if self._tokens is not None:
            self._tokens.close(timeout)
        if (left := len(self._events)) > 0:
            self.dropped_events += left
            log.warning("%d events were not published: the network did not accept them within %g s", left, timeout)

    def _join(self, session: zenoh.Session, credentials: LoadedCredentials) -> SessionSubscriptions:
        return SessionSubscriptions(session, credentials, self._streams, self._config.liveliness, self._loss_counter)

    def _begin(self, session: zenoh.Session, credentials: LoadedCredentials) -> None:
        subscriptions = self._join(session, credentials)
        for stream, pump, subscription in zip(self._streams, self._pumps, subscriptions.of_streams, strict=True):
            stream_input = StreamInput(subscription, history=stream.history is not None)
            name = f"stream {stream.name}"
            thread = threading.Thread(target=self._receive, args=(stream_input, pump), name=name, daemon=True)
            thread.start()
            self._inputs.append(stream_input)
            self._receivers.append(thread)
        if subscriptions.tokens is not None:
            self._tokens = TokenWatch(subscriptions.tokens, subscriptions.connections, self._put_token)
        self._use(subscriptions)
        self._renewal = Renewal(
            self._config,
            subscriptions,
            self._inputs,
            self._tokens,
            self._join,
            self._use,
            check_every=self._check_every,
            on_failure=self._on_failure,
        )
        self._renewal.start()

    def _use(self, subscriptions: SessionSubscriptions) -> None:
        """Publish events and handle queries here from now on."""
        self._subscriptions = subscriptions
        if self._make_query_handler is not None:
            subscriptions.answer(self._make_query_handler)

    def _receive(self, stream_input: StreamInput, pump: Pump) -> None:
        """Delivers the samples of a stream, until the session is closed."""
        try:
            pump(stream_input.bursts())
        except Exception as error:  # noqa: BLE001  otherwise the stream would stay silent
            if not self._stop.is_set():
                log.critical("the thread of a stream ended; receiving from it has stopped: %s", error)
                self._on_failure(error)

    def _run(self) -> None:
        try:
            self._serve()
        except Exception as error:  # noqa: BLE001  otherwise events would stay queued
            log.critical("the network thread ended; publishing events has stopped: %s", error)
            self._on_failure(error)

    def _serve(self) -> None:
        if self._subscriptions is None:
            opened = await_session(self._config, self._stop)
            if opened is None:
                return
            self._begin(*opened)
        while (event := self._next()) is not None:
            self._send(*event)

    def _next(self) -> tuple[str, bytes, str] | None:
        """The next event; None when closing and the queue is empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._events or self._stop.is_set())
            return self._events.popleft() if self._events else None

    def _send(self, key: str, payload: bytes, encoding: str) -> None:
        subscriptions = self._subscriptions
        while subscriptions is not None:  # None: closed in the meantime, after the time for queued events
            try:
                # BLOCK: events are few and should survive a short congestion; only this thread waits for it.
                with subscriptions.used() as session:
                    session.put(
                        key,
                        payload,
                        encoding=encoding,
                        congestion_control=zenoh.CongestionControl.BLOCK,
                        express=True,
                    )
                return
            except zenoh.ZError as error:
                before, subscriptions = subscriptions, self._successor(subscriptions)
                if subscriptions is before:
                    log.warning("cannot publish the event on %s: %s", key, error)
                    break
        self.dropped_events += 1

    def _successor(self, subscriptions: SessionSubscriptions) -> SessionSubscriptions | None:
        """The membership that replaces it, now or in a moment; itself if there is none, None once all is closed."""
        renewal = self._renewal
        while renewal is not None and renewal.reopening.is_set() and self._subscriptions is subscriptions:
            if self._stop.wait(0.01):
                break
        return self._subscriptions
