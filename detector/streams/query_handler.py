"""Handles Zenoh queries about a detector: one queryable for its keys, on a separate thread.

    wayside/detectors/<holder>/<what>?name=value;…

A response is JSON. A request that cannot be handled gets an error reply with the reason. `query_detectors` is the
counterpart: it queries running detectors.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import zenoh

from detector.streams.session import open_session
from wayside.api.zenoh import Zenoh
from wayside.inputerror import InputError

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


class QueryHandler:
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


_PATIENCE = 0.2
"""Seconds between two attempts to find a detector."""


class NoAnswerError(InputError, ValueError):
    """There was no response, or it was a refusal; the message gives the reason."""


@dataclass(frozen=True, slots=True)
class Reply:
    """One detector's response, as JSON."""

    key: str
    payload: bytes

    @property
    def holder(self) -> str:
        """The detector that responded."""
        return self.key.split("/")[2]


def query_detectors(
    config: Zenoh,
    holder: str,
    what: str,
    given: Mapping[str, str],
    timeout: float,
    payload: bytes | None = None,
    complete: Callable[[Sequence[Reply]], bool] = bool,
) -> list[Reply]:
    """The responses of all detectors with that name (`*`: with any), within `timeout` seconds.

    The query is repeated until the responses are `complete`, by default until there is one. At the timeout, those of
    the last query are returned.

    Raises:
        NetworkError: no session.
        NoAnswerError: there was no response, or every response was a refusal.
    """
    selector = status_key(holder, what) + "".join(
        f"{'?' if number == 0 else ';'}{name}={value}" for number, (name, value) in enumerate(given.items())
    )
    end = time.monotonic() + timeout
    with open_session(config) as session:
        while True:
            answers: list[Reply] = []
            refusals: list[str] = []
            left = max(0.1, end - time.monotonic())
            for reply in session.get(selector, payload=payload, timeout=left, target=zenoh.QueryTarget.ALL):
                if (ok := reply.ok) is not None:
                    answers.append(Reply(str(ok.key_expr), ok.payload.to_bytes()))
                elif (error := reply.err) is not None:
                    refusals.append(error.payload.to_string())
            last = time.monotonic() + _PATIENCE >= end
            if complete(answers) or (answers and last):
                return sorted(answers, key=lambda answer: answer.key)
            if not answers and any("Timeout" not in text for text in refusals):
                raise NoAnswerError("; ".join(sorted({text for text in refusals if "Timeout" not in text})))
            # A peer has just connected, and may not know the queryables yet.
            if last:
                where = ", ".join(config.connect) or "the local network"
                raise NoAnswerError(
                    f"no response from detector {holder} at {where} within {timeout:g} s: is it running, "
                    "and is this its Zenoh network? Give --connect ENDPOINT, e.g. tcp/127.0.0.1:7447"
                )
            time.sleep(_PATIENCE)
