"""Handles Zenoh queries about a detector: one queryable for its keys, on a separate thread.

    wayside/detectors/<holder>/<what>?name=value;…

A response is JSON. A request that cannot be handled gets an error reply with the reason.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping

import zenoh

_log = logging.getLogger(__name__)

Answer = Callable[[str, Mapping[str, str], bytes], bytes]
"""Receives the name of the request, its parameters and the payload of the query (often empty); returns JSON.

Raises ValueError if it cannot.
"""

JSON = "application/json"

_CHANNEL = 64
"""Maximum number of queued queries; Zenoh holds back further ones until their timeout."""


def status_key(holder: str, what: str) -> str:
    """The key on which a detector responds; `*` for any."""
    return f"wayside/detectors/{holder}/{what}"


class Answering:
    """Handles the queries of one session until that is closed."""

    def __init__(self, session: zenoh.Session, holder: str, answer: Answer) -> None:
        """Raises zenoh.ZError if the queryable cannot be declared."""
        self._holder = holder
        self._answer = answer
        self._queryable = session.declare_queryable(
            status_key(holder, "*"), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        self._thread = threading.Thread(target=self._run, name="answering", daemon=True)
        self._thread.start()

    def join(self, timeout: float) -> None:
        """The session is closed: wait at most `timeout` seconds for the thread."""
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            try:
                query = self._queryable.handler.recv()
            except zenoh.ZError:
                return
            try:
                self._reply(query)
            except Exception as error:  # noqa: BLE001  one bad query must not stop the thread
                _log.warning("cannot answer a query of %s: %s", query.key_expr, error)
            finally:
                query.drop()  # type: ignore[no-untyped-call]  # ends the query, whatever was replied

    def _reply(self, query: zenoh.Query) -> None:
        parts = (part.partition("=") for part in str(query.parameters).split(";") if part)
        parameters = {name: value for name, _, value in parts}
        page = str(query.key_expr).rsplit("/", 1)[-1]
        what = "status" if page.startswith("*") else page
        try:
            given = query.payload
            payload = self._answer(what, parameters, b"" if given is None else given.to_bytes())
        except ValueError as error:
            query.reply_err(str(error), encoding="text/plain")
            return
        query.reply(status_key(self._holder, what), payload, encoding=JSON)
