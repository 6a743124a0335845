"""An HTTP endpoint that records: it receives a request at the start and one at the end.

The header Idempotency-Key identifies a repeated request. The response decides: a start that is finally rejected is not
sent again, and a stop of an unknown recording (404, 410) counts as done.
"""

from __future__ import annotations

import json
import threading
import time

from yarl import URL

from detector.actions.base import ActionError
from detector.actions.http import Disposition, HttpClient, HttpError, judge
from detector.actions.trigger.orders import Order, Progress, Report, nested_value
from wayside.api.actions.trigger import HttpCall, TriggerAction
from wayside.names import encode

_GONE = (404, 410)
_CONFLICT = 409


class HttpEndpoint:
    """Requests recordings from an HTTP endpoint."""

    renew: float | None = None
    ends_by_itself = False

    def __init__(self, parameters: TriggerAction, closing: threading.Event) -> None:
        """Once `closing` is set, a running request is aborted; a later one may take its full time."""
        assert parameters.http is not None  # noqa: S101  the caller checked it
        self._wanted = parameters.http
        self._maximum = parameters.maximum_duration
        self.timeout = parameters.http.timeout.seconds
        self._closing = closing
        self._client = HttpClient(parameters.http, "trigger.http")
        self._unanswered: set[str] = set()
        """The recordings whose start was sent without a response."""

    def place(self, order: Order) -> str:
        """Scheme, host and port of the first request."""
        url = URL(next(iter(self._wanted.calls.values())).url, encoded=True)
        return f"{url.scheme}://{url.host}:{url.port}"

    def start(self, order: Order, ago: float, *, again: bool) -> Report:
        """Send `start`."""
        if self._wanted.start is None:
            return Report(Progress.RECORDING)
        try:
            status, verdict, message = self._send("start", self._wanted.start, order)
        except ActionError:
            self._unanswered.add(order.id)
            raise
        repeated = again or order.id in self._unanswered
        self._unanswered.discard(order.id)
        if verdict is Disposition.DONE or (status == _CONFLICT and repeated):
            return Report(Progress.RECORDING)
        return Report(Progress.FAILED, message)

    def stop(self, order: Order, ago: float) -> Report:
        """Send `stop`."""
        if self._wanted.stop is None:
            return Report(Progress.DONE)
        status, verdict, message = self._send("stop", self._wanted.stop, order)
        if verdict is Disposition.DONE:
            return Report(Progress.DONE)
        return Report(Progress.DONE if status in _GONE else Progress.REFUSED, message)

    def status(self, order: Order) -> Report:
        """There is no more information than in the responses."""
        return Report(Progress.DONE)

    def _send(self, name: str, call: HttpCall, order: Order) -> tuple[int, Disposition, str]:
        """The status, its consequence and the message. Raises ActionError if a retry is worthwhile."""
        body = nested_value(order.rendered, "http", name, "body")
        if body is None:
            body = {"id": order.id, "do": name, "maximumDuration": str(self._maximum), "event": order.event}
        headers = {"Content-Type": "application/json", "Idempotency-Key": f"{order.id}.{name}"}
        url = call.url.replace("{id}", encode(order.id))
        end, closing = time.monotonic() + self.timeout, self._closing.is_set()

        def give_up() -> bool:
            return time.monotonic() >= end or self._closing.is_set() is not closing

        try:
            text = json.dumps(body, separators=(",", ":"), allow_nan=False).encode()
            answer = self._client.send(call.method.value, url, headers, text, give_up=give_up)
        except (HttpError, ValueError) as error:
            raise ActionError(str(error)) from error
        verdict, message = judge(answer)
        if verdict is Disposition.AGAIN:
            raise ActionError(f"{self.place(order)} {message}")
        return answer.status, verdict, f"{self.place(order)} {message}"
