"""Follows the clients' liveliness tokens, and tells what happens to them as arrivals for the intake.

When our connection to a router ends, Zenoh reports all tokens behind it as gone, a moment before the connection
itself. So a token that is gone is looked at again shortly after: only if no router left since the token was declared,
or that is long ago, is it the client that is gone.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence

import zenoh

from detector.engine.samples.liveliness import Token
from detector.streams.session import Connections
from wayside.keys import KeyPattern

log = logging.getLogger(__name__)

_SETTLE = 0.2
"""Seconds between a report that a token is gone and the belief in it."""

_DOUBT = 10.0
"""Seconds after a router left in which tokens that were declared before are not believed to be dropped."""

_CHANNEL = 16_384


class TokenWatch:
    """Tells of tokens while its session is open; at its end, that nothing is known of them any more."""

    def __init__(
        self,
        session: zenoh.Session,
        connections: Connections,
        key: str,
        put: Callable[[Sequence[tuple[str, bytes]]], None],
    ) -> None:
        """`key` is a pattern in key-format notation. Raises KeyPatternError."""
        self._put = put
        self._connections = connections
        self._stop = threading.Event()
        self._held: dict[str, int] = {}
        """The tokens that are there, and how many routers had left when they were declared."""
        expression = zenoh.KeyExpr.autocanonize(KeyPattern.parse(key).expression)
        self._subscriber = session.liveliness().declare_subscriber(
            expression, zenoh.handlers.FifoChannel(_CHANNEL), history=True
        )
        self._thread = threading.Thread(target=self._run, name="liveliness", daemon=True)
        self._thread.start()

    def close(self, timeout: float) -> None:
        """Ends once the session is closed; waits at most that many seconds for it."""
        self._stop.set()
        self._thread.join(timeout)

    def _run(self) -> None:
        tokens = self._subscriber.handler
        try:
            while True:
                self._tell([tokens.recv()], tokens)
        except zenoh.ZError:  # the session is closed
            self._put([(key, Token.UNSURE.value) for key in self._held])

    def _tell(self, reports: list[zenoh.Sample], tokens: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """What a report and those that follow it at once come to, a token at a time."""
        if reports[0].kind == zenoh.SampleKind.DELETE and not self._stop.wait(_SETTLE):
            while (report := tokens.try_recv()) is not None:
                reports.append(report)
        newest = {str(report.key_expr): report.kind for report in reports}
        for key, kind in newest.items():
            if kind == zenoh.SampleKind.PUT:
                self._held[key] = self._connections.departures
                self._put([(key, Token.DECLARED.value)])
            elif key in self._held:
                departed = self._held.pop(key) != self._connections.departures
                unsure = self._stop.is_set() or (departed and self._connections.router_left_within(_DOUBT))
                self._put([(key, (Token.UNSURE if unsure else Token.DROPPED).value)])
