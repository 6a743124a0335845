"""Systems that record: another detector, or an HTTP endpoint, which receives a request at the start and the end.

The header Idempotency-Key identifies a repeated request. The response decides: a start that is finally rejected is not
sent again, and a stop of an unknown recording (404, 410) counts as done.
"""

from __future__ import annotations

import json
import re
import threading
import time

from yarl import URL

from detector.actions.base import ActionError, Messenger
from detector.actions.http import HttpClient, HttpError, ResponseOutcome, judge
from detector.actions.http.client import origin
from detector.actions.trigger.requests import (
    MAXIMUM_CLIENTS,
    RECORDINGS,
    Order,
    Progress,
    RecordingRequest,
    Report,
    duration,
    nested_value,
    read_report,
    short,
    write_request,
)
from detector.streams.query_handler import status_key
from wayside.api.actions.trigger import HttpCall, TriggerAction
from wayside.api.actions.window import WindowClients
from wayside.api.base import Duration
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
        self._maximum = parameters.max_duration
        self.timeout = parameters.http.timeout.seconds
        self._closing = closing
        self._client = HttpClient(parameters.http, "trigger.http")
        self._unanswered: set[str] = set()
        """The recordings whose start was sent without a response."""

    def place(self, order: Order) -> str:
        """Scheme, host and port of the first request."""
        return origin(URL(next(iter(self._wanted.calls.values())).url, encoded=True))

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
        if verdict is ResponseOutcome.DONE or (status == _CONFLICT and repeated):
            return Report(Progress.RECORDING)
        return Report(Progress.FAILED, message)

    def stop(self, order: Order, ago: float) -> Report:
        """Send `stop`."""
        if self._wanted.stop is None:
            return Report(Progress.DONE)
        status, verdict, message = self._send("stop", self._wanted.stop, order)
        if verdict is ResponseOutcome.DONE:
            return Report(Progress.DONE)
        return Report(Progress.DONE if status in _GONE else Progress.REFUSED, message)

    def status(self, order: Order) -> Report:
        """There is no more information than in the responses."""
        return Report(Progress.DONE)

    def _send(self, name: str, call: HttpCall, order: Order) -> tuple[int, ResponseOutcome, str]:
        """The status, its consequence and the message. Raises ActionError if a retry is worthwhile."""
        body = nested_value(order.rendered, "http", name, "body")
        if body is None:
            body = {"id": order.id, "do": name, "maxDuration": str(self._maximum), "event": order.event}
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
        if verdict is ResponseOutcome.AGAIN:
            raise ActionError(f"{self.place(order)} {message}")
        return answer.status, verdict, f"{self.place(order)} {message}"


_RENEW = 5.0
"""Seconds between repeated starts: a restarted detector has lost its recordings, and continues with the next start."""

_HOLDER = re.compile(r"[A-Za-z0-9_.-]{1,253}")


class OtherDetector:
    """Requests recordings from another detector."""

    renew: float | None = _RENEW
    ends_by_itself = True

    def __init__(self, parameters: TriggerAction, messenger: Messenger) -> None:
        assert parameters.detector is not None  # noqa: S101  the caller checked it
        self._wanted = parameters.detector
        self._maximum = parameters.max_duration
        self.timeout = parameters.timeout.seconds
        self._messenger = messenger

    def place(self, order: Order) -> str:
        """The other detector's holder."""
        name = nested_value(order.rendered, "detector", "name")
        if not isinstance(name, str) or not _HOLDER.fullmatch(name):
            raise ActionError(f"detector.name must have only letters, digits, _, . and -; got {name!r}")
        return name

    def start(self, order: Order, ago: float, *, again: bool) -> Report:
        """Start; if it was confirmed before, without samples from earlier."""
        wanted = self._wanted
        subjects = nested_value(order.event, "data", "subjects")
        clients = None
        if wanted.clients is WindowClients.SUBJECTS and subjects:
            clients = sorted({*subjects, *wanted.with_clients})
            if len(clients) > MAXIMUM_CLIENTS:
                clients = None
        request = RecordingRequest(
            do="start",
            id=order.id,
            streams=wanted.streams,
            clients=clients,
            before=Duration("0s") if again else wanted.before,
            ago=Duration("0s") if again else duration(ago),
            max_duration=self._maximum,
            event=short(order.event),
        )
        return self._request(order, request)

    def stop(self, order: Order, ago: float) -> Report:
        """Stop, `after` later."""
        return self._request(
            order, RecordingRequest(do="stop", id=order.id, after=self._wanted.after, ago=duration(ago))
        )

    def status(self, order: Order) -> Report:
        """Request its progress."""
        return self._request(order, RecordingRequest(id=order.id))

    def _request(self, order: Order, request: RecordingRequest) -> Report:
        name = self.place(order)
        answers = self._messenger.query(status_key(name, RECORDINGS), write_request(request), self.timeout)
        try:
            report = read_report(answers[0])
        except (IndexError, ValueError) as error:
            raise ActionError(f"detector {name} returned an unexpected response: {error}") from error
        return Report(report.state, report.message, report.samples, report.bytes, report.missing, tuple(report.files))
