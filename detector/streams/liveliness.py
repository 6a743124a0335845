"""Follows the clients' liveliness tokens, and passes their changes as arrivals to the intake.

When our connection to a router ends, Zenoh reports all tokens behind it as gone, a moment before the connection itself.
Therefore a token that is gone is checked again shortly after. Only if no router left since the token was declared, or
that was long ago, the client itself is gone.
"""

from __future__ import annotations

import logging
import threading

import zenoh

from detector.engine.samples.intake import Put
from detector.engine.samples.liveliness import TokenState
from detector.streams.session import Connections
from wayside.keys import KeyPattern

log = logging.getLogger(__name__)

_LOSS_DELAY = 0.2
"""Seconds until a reported loss of a token takes effect: a token that is declared again by then is not lost."""

_DOUBT = 10.0
"""Seconds after a router left in which losses of tokens declared earlier are ignored."""

_CHANNEL = 16_384


Report = tuple[str, zenoh.SampleKind]

Tokens = zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]


def subscribe_tokens(session: zenoh.Session, key: str) -> Tokens:
    """`key` is a pattern in key-format notation; existing tokens are reported. Raises KeyPatternError, ZError."""
    expression = zenoh.KeyExpr.autocanonize(KeyPattern.parse(key).expression)
    return session.liveliness().declare_subscriber(expression, zenoh.handlers.FifoChannel(_CHANNEL), history=True)


class TokenWatch:
    """Reports tokens while a session is open; at the end of the last session it reports their state as unknown."""

    def __init__(
        self,
        subscriber: Tokens,
        connections: Connections,
        put: Put,
    ) -> None:
        """`connections`: of the subscriber's session."""
        self._put = put
        self._connections = connections
        self._stop = threading.Event()
        self._held: dict[str, int] = {}
        """The existing tokens, each with the number of routers that had left when it was declared."""
        self._subscriber = subscriber
        self._following: tuple[Tokens, Connections] | None = None
        self._changed = threading.Condition()
        self._expecting = False
        self._thread = threading.Thread(target=self._run, name="liveliness", daemon=True)
        self._thread.start()

    def expect(self) -> None:
        """The current session will be closed, and `follow` or `close` will be called."""
        with self._changed:
            self._expecting = True

    def follow(self, subscriber: Tokens, connections: Connections) -> None:
        """Switch to this subscriber of another session, once the current one is undeclared or its session closed."""
        with self._changed:
            self._following = subscriber, connections
            self._changed.notify_all()

    @property
    def alive(self) -> bool:
        """Whether tokens are still followed."""
        return self._thread.is_alive()

    def close(self, timeout: float) -> None:
        """Ends once the session is closed; waits at most that many seconds for it."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            tokens = self._subscriber.handler
            try:
                while True:
                    self._apply([_report(tokens.recv())], tokens)
            except zenoh.ZError:  # undeclared, or the session is closed
                with self._changed:
                    self._changed.wait_for(
                        lambda: self._following is not None or self._stop.is_set() or not self._expecting
                    )
                    if self._following is None:
                        self._put([(key, TokenState.UNSURE.value) for key in self._held])
                        return
                    (self._subscriber, self._connections), self._following = self._following, None
                    self._expecting = False
            self._compare()

    def _compare(self) -> None:
        """Compare the tokens with the first report of another session: tokens that it does not contain are gone."""
        self._held = dict.fromkeys(self._held, self._connections.departures)
        tokens = self._subscriber.handler
        reports = [_report(each) for each in iter(tokens.try_recv, None)]
        there = {key for key, kind in reports if kind == zenoh.SampleKind.PUT}
        gone = [(key, zenoh.SampleKind.DELETE) for key in self._held if key not in there]
        new = [(key, kind) for key, kind in reports if kind == zenoh.SampleKind.DELETE or key not in self._held]
        if gone or new:
            self._apply([*gone, *new], tokens)

    def _apply(self, reports: list[Report], tokens: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """Apply a report and the immediately following ones, one token at a time."""
        if reports[0][1] == zenoh.SampleKind.DELETE and not self._stop.wait(_LOSS_DELAY):
            reports.extend(_report(each) for each in iter(tokens.try_recv, None))
        newest = dict(reports)
        for key, kind in newest.items():
            if kind == zenoh.SampleKind.PUT:
                self._held[key] = self._connections.departures
                self._put([(key, TokenState.DECLARED.value)])
            elif key in self._held:
                departed = self._held.pop(key) != self._connections.departures
                unsure = self._stop.is_set() or (departed and self._connections.router_left_within(_DOUBT))
                self._put([(key, (TokenState.UNSURE if unsure else TokenState.DROPPED).value)])


def _report(sample: zenoh.Sample) -> Report:
    return str(sample.key_expr), sample.kind
