"""Another detector as the recording system: it receives queries on `wayside/detectors/<name>/recordings`."""

from __future__ import annotations

import re

from detector.actions.base import ActionError, Messenger
from detector.actions.trigger.orders import Order, Report, nested_value
from detector.actions.trigger.requests import (
    MAXIMUM_CLIENTS,
    RECORDINGS,
    RecordingRequest,
    duration,
    read_report,
    short,
    write_request,
)
from detector.streams.answering import status_key
from wayside.api.actions.trigger import TriggerAction
from wayside.api.actions.window import WindowClients
from wayside.api.base import Duration

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
        self._maximum = parameters.maximum_duration
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
            maximum_duration=self._maximum,
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
