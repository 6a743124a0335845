"""The index of requested recordings: the effect of a request, and its response. Pure.

A recording is identified by the id that its requester chose, so a repeated request has no further effect. Finished
recordings stay in the index for a while: a later request returns their result, and a start that arrives after its own
stop begins nothing.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from detector.actions.episode import Outcome, OutcomeState
from detector.actions.trigger.orders import Progress
from detector.actions.trigger.requests import RecordingReport, RecordingRequest, time_text
from wayside.api.recordings import OnRequest

_REMEMBERED = 1000
"""Maximum number of finished recordings in the index."""

BY_ITSELF = "ended by its maximumDuration"


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
        longest = min(request.maximum_duration.ns, allowed.maximum_duration.ns)
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
        if open_ones >= allowed.maximum_recordings:
            return f"{open_ones} recordings are in progress, the maximum (recordings.onRequest.maximumRecordings)"
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
