"""Handles recording requests: the index decides, the evaluation thread carries it out."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

from detector.actions.episode import Outcome, OutcomeState
from detector.actions.outcomes import ActionKey
from detector.actions.trigger.requests import RecordingReport, RecordingRequest, read_request, write_reports
from detector.engine.consequences.consequences import ActionRun, Consequences
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord, identifier
from detector.live.requested.index import RecordingIndex, RequestedRecording
from wayside.api import API_VERSION, Detector, EventRule
from wayside.names import FLEET, parse_subject
from wayside.rules.actions import window_of

REQUESTED = ActionKey("_requested", "record")
"""The rule and the action under which they run: no EventRule in a cluster can have that name."""


def with_requested(rules: Sequence[EventRule], detector: Detector) -> list[EventRule]:
    """The rules whose actions run, including the rule for recordings on request if the Detector allows these."""
    recordings = detector.spec.recordings
    if recordings is None or recordings.on_request is None:
        return list(rules)
    rule = EventRule.model_validate(
        {
            "apiVersion": API_VERSION,
            "kind": "EventRule",
            "metadata": {"name": REQUESTED.rule, "namespace": detector.namespace},
            "spec": {
                "description": "Recordings requested by others.",
                "when": "false",
                "actions": [{"name": REQUESTED.action, "record": {}}],
            },
        }
    )
    return [*rules, rule]


def run_of(identity: str) -> ActionRun:
    """The run of a recording; its episode is a short name derived from the id, which may be long."""
    return ActionRun(REQUESTED.rule, REQUESTED.action, identifier(identity.encode()))


def begin_recording(
    consequences: Consequences,
    entry: RequestedRecording,
    detector: Detector,
    holder: str,
    clients: Sequence[str] | None,
    cause: dict[str, Any],
    now: int,
) -> None:
    """Begin to pass on the samples of the recording. `cause` is the requester's event; nothing in it is trusted."""
    subject, subjects = _about(cause)
    data = cause.get("data")
    classification = data.get("classification") if isinstance(data, dict) else None
    run = run_of(entry.id)
    episode = EpisodeRecord(
        id=run.episode,
        rule=run.rule,
        subject=subject,
        clients=subjects,
        element=None,
        onset_time=now if entry.since is None else min(now, entry.since),
        start_time=now,
        values={"request": entry.id, "event": cause},
        classification=classification if isinstance(classification, dict) else None,
    )
    streams = [stream for stream in detector.spec.streams if stream.name in entry.streams]
    wanted = None if clients is None else frozenset(clients)
    window = window_of(detector.spec, streams, wanted)
    event = Event(holder, episode, episode.values)
    consequences.request(run, event, window, wanted, episode.onset_time, entry.until or now)


def _about(cause: dict[str, Any]) -> tuple[str, tuple[str, ...]]:
    """The subject of the requester's event; it is part of file names."""
    subject = cause.get("subject")
    if isinstance(subject, str) and len(subject) <= 256:
        try:
            return subject, parse_subject(subject)[0]
        except ValueError:
            pass
    return FLEET, ()


_log = logging.getLogger(__name__)

_PATIENCE = 5.0
"""Seconds to wait for the evaluation."""

Call = Callable[[Callable[[], None]], Future[Any]]
"""Runs a function on the thread of the evaluation."""


class RequestedRecordings:
    """Recordings requested by others. Thread-safe."""

    def __init__(self, engine: Engine, call: Call) -> None:
        self._engine = engine
        self._call = call
        self._lock = threading.Lock()
        self._index = RecordingIndex()
        self._runs: dict[str, str] = {}
        """The ids by episode, of unfinished recordings."""

    def answer(self, payload: bytes) -> bytes:
        """The response to a request, as JSON. Raises ValueError, with a message for the requester."""
        request = read_request(payload)
        if request.do == "status":
            with self._lock:
                return write_reports(self._index.status(request.id))
        return write_reports(self._start(request) if request.do == "start" else self._stop(request))

    def on_outcome(self, which: ActionKey, episode: str, outcome: Outcome) -> None:
        """Handle an outcome of an action; only recordings on request matter here."""
        if which != REQUESTED:
            return
        with self._lock:
            identity = self._runs.get(episode)
            if identity is None:
                return
            self._index.update(identity, outcome)
            if outcome.state is OutcomeState.RUNNING:
                return
            del self._runs[episode]
        if outcome.state is OutcomeState.FAILED:
            self._call(lambda: self._release(identity, None))  # it may have failed long before its end

    def _start(self, request: RecordingRequest) -> RecordingReport:
        detector = self._engine.detector
        recordings = detector.spec.recordings
        allowed = None if recordings is None else recordings.on_request
        names = [stream.name for stream in detector.spec.streams]
        with self._lock:
            report, entry = self._index.start(request, allowed, names, self._engine.now)
            if entry is None:
                return report
            self._runs[run_of(entry.id).episode] = entry.id
        _log.info("starting recording %s on request", entry.id)
        try:
            self._in_time(self._call(lambda: self._begin(entry, request)))
        except Exception:
            with self._lock:
                self._index.withdraw(entry.id)
                self._runs.pop(run_of(entry.id).episode, None)
            raise
        return report

    def _stop(self, request: RecordingRequest) -> RecordingReport:
        with self._lock:
            report, entry = self._index.stop(request, self._engine.now)
        if entry is not None and entry.until is not None:
            until = entry.until
            _log.info("stopping recording %s on request", entry.id)
            self._in_time(self._call(lambda: self._release(entry.id, until)))
        return report

    def _begin(self, entry: RequestedRecording, request: RecordingRequest) -> None:
        """Runs on the evaluation thread. The end of a recording that was stopped by now is known: it is so short."""
        engine = self._engine
        begin_recording(
            engine.consequences,
            entry,
            engine.detector,
            engine.identity.holder,
            request.clients,
            request.event,
            engine.now,
        )

    def _release(self, identity: str, until: int | None) -> None:
        """Runs on the evaluation thread; None: now."""
        self._engine.consequences.release(run_of(identity), self._engine.now if until is None else until)

    def _in_time(self, future: Future[Any]) -> None:
        try:
            future.result(_PATIENCE)
        except TimeoutError:
            # It is carried out later: a repeated request with the same id returns its state.
            _log.warning("the evaluation thread did not process a recording request within %g s", _PATIENCE)
