"""Recordings requested over Zenoh: the index decides, and the evaluation thread begins and ends them.

A recording is identified by the id that its requester chose, so a repeated request has no further effect. Finished
recordings stay in the index for a while: a later request returns their result, and a start that arrives after its own
stop begins nothing.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from detector.actions.episode import Outcome, OutcomeState
from detector.actions.outcomes import ActionKey
from detector.actions.trigger.requests import (
    Progress,
    RecordingReport,
    RecordingRequest,
    read_request,
    time_text,
    write_reports,
)
from detector.engine.consequences import ActionRun
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord, identifier
from wayside.api import API_VERSION, Detector, EventRule
from wayside.api.recordings import OnRequest
from wayside.names import FLEET, parse_subject
from wayside.rules.actions import window_of

_log = logging.getLogger(__name__)

_REMEMBERED = 1000
"""Maximum number of finished recordings in the index."""

BY_ITSELF = "ended by its maxDuration"


@dataclass(slots=True)
class RequestedRecording:
    """One recording. Times are nanoseconds since the epoch, on the detector's time axis."""

    id: str
    state: Progress
    streams: tuple[str, ...] = ()
    since: int | None = None
    until: int | None = None
    stopped: bool = False
    """Whether its end was requested."""
    message: str = ""
    outcome: Outcome = field(default_factory=lambda: Outcome(OutcomeState.RUNNING))

    def report(self) -> RecordingReport:
        """The report about it."""
        outcome = self.outcome
        return RecordingReport(
            id=self.id,
            state=self.state,
            message=self.message or outcome.message,
            streams=list(self.streams),
            since=time_text(self.since),
            until=time_text(self.until),
            samples=outcome.samples,
            bytes=outcome.bytes,
            missing=outcome.missing,
            files=list(outcome.files),
        )


class RecordingIndex:
    """The recordings by id. For one thread at a time."""

    def __init__(self) -> None:
        self._entries: dict[str, RequestedRecording] = {}

    def start(
        self, request: RecordingRequest, allowed: OnRequest | None, streams: Collection[str], now: int
    ) -> tuple[RecordingReport, RequestedRecording | None]:
        """The response, and the recording to begin, if any.

        `allowed` is None if requests are not permitted; `streams` are those of the detector.
        """
        identity = request.id or ""
        known = self._entries.get(identity)
        if known is not None:
            return known.report(), None
        refusal = self._refusal(request, allowed, streams)
        if allowed is None or refusal:
            return RecordingReport(identity, Progress.REFUSED, refusal), None
        chosen = request.streams or allowed.streams or sorted(streams)
        longest = min(request.max_duration.ns, allowed.max_duration.ns)
        since = now - request.ago.ns - request.before.ns
        entry = RequestedRecording(identity, Progress.RECORDING, tuple(chosen), since, now + longest)
        self._entries[identity] = entry
        self._forget()
        return entry.report(), entry

    def stop(self, request: RecordingRequest, now: int) -> tuple[RecordingReport, RequestedRecording | None]:
        """The response, and the recording whose `until` was shortened, if any."""
        identity = request.id or ""
        entry = self._entries.get(identity)
        if entry is None:
            message = "the recording was stopped before it was started"
            self._entries[identity] = RequestedRecording(identity, Progress.UNKNOWN, stopped=True, message=message)
            self._forget()
            return RecordingReport(identity, Progress.UNKNOWN, "this detector does not know the recording"), None
        if entry.state is not Progress.RECORDING:
            return entry.report(), None
        entry.state, entry.stopped = Progress.ENDING, True
        if entry.until is not None:
            entry.until = min(entry.until, max(now - request.ago.ns + request.after.ns, entry.since or 0))
        return entry.report(), entry

    def status(self, identity: str | None) -> RecordingReport | list[RecordingReport]:
        """The state of one recording, or of all."""
        if identity is None:
            return [entry.report() for entry in self._entries.values() if entry.since is not None]
        entry = self._entries.get(identity)
        return RecordingReport(identity, Progress.UNKNOWN) if entry is None else entry.report()

    def update(self, identity: str, outcome: Outcome) -> None:
        """Apply an outcome of the recording."""
        entry = self._entries.get(identity)
        if entry is None or entry.state.over:
            return
        entry.outcome = outcome
        if outcome.state is OutcomeState.RUNNING:
            return
        entry.state = Progress.DONE if outcome.state is OutcomeState.DONE else Progress.FAILED
        if entry.state is Progress.DONE and not entry.stopped:
            entry.message = BY_ITSELF

    def withdraw(self, identity: str) -> None:
        """Remove a recording that could not be started."""
        self._entries.pop(identity, None)

    def _refusal(self, request: RecordingRequest, allowed: OnRequest | None, streams: Collection[str]) -> str:
        if allowed is None:
            return "this detector accepts no recording requests: allow them in its spec.recordings.onRequest"
        open_ones = sum(not entry.state.over for entry in self._entries.values())
        if open_ones >= allowed.max_recordings:
            return f"{open_ones} recordings are in progress, the maximum (recordings.onRequest.maxRecordings)"
        may = streams if allowed.streams is None else allowed.streams
        for name in request.streams or ():
            if name not in may:
                return f"stream {name} may not be recorded here; the permitted streams are {', '.join(sorted(may))}"
        return ""

    def _forget(self) -> None:
        if len(self._entries) <= _REMEMBERED:
            return
        over = [entry.id for entry in self._entries.values() if entry.state.over]
        for identity in over[: max(0, len(over) - _REMEMBERED)]:
            del self._entries[identity]


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
            "metadata": {"name": "requested", "namespace": detector.namespace},
            "spec": {
                "description": "Recordings requested by others.",
                "when": "false",
                "actions": [{"name": REQUESTED.action, "record": {}}],
            },
        }
    )
    metadata = rule.metadata.model_copy(update={"name": REQUESTED.rule})  # not valid, so no other rule has it
    return [*rules, rule.model_copy(update={"metadata": metadata})]


def run_of(identity: str) -> ActionRun:
    """The run of a recording; its episode is a short name derived from the id, which may be long."""
    return ActionRun(REQUESTED.rule, REQUESTED.action, identifier(identity.encode()))


def _about(cause: dict[str, Any]) -> tuple[str, tuple[str, ...]]:
    """The subject of the requester's event; it is part of file names."""
    subject = cause.get("subject")
    if isinstance(subject, str) and len(subject) <= 256:
        try:
            return subject, parse_subject(subject)[0]
        except ValueError:
            pass
    return FLEET, ()


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
        """Begin to pass on the samples of the recording, on the evaluation thread.

        Nothing in the requester's event is trusted. The end is already known if the recording was stopped before.
        """
        detector, cause, now = self._engine.detector, request.event, self._engine.now
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
        wanted = None if request.clients is None else frozenset(request.clients)
        window = window_of(detector.spec, streams, wanted)
        event = Event(self._engine.identity.holder, episode, episode.values)
        self._engine.consequences.request(run, event, window, wanted, episode.onset_time, entry.until or now)

    def _release(self, identity: str, until: int | None) -> None:
        """End the recording at `until`, None: now; runs on the evaluation thread."""
        self._engine.consequences.release(run_of(identity), self._engine.now if until is None else until)

    def _in_time(self, future: Future[Any]) -> None:
        try:
            future.result(_PATIENCE)
        except TimeoutError:
            # It is carried out later: a repeated request with the same id returns its state.
            _log.warning("the evaluation thread did not process a recording request within %g s", _PATIENCE)
