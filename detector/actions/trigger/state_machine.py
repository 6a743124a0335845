"""The state machine of one recording on another system: its confirmed state, and the next request with its time.

Level-triggered: the other system should record as long as the episode lasts, and not afterwards. Unconfirmed requests
are retried with backoff until they are given up. A start is requested even if the episode has ended in the meantime,
because the other system may have the time before in its buffer.

    START ─confirmed→ HOLD ─end or maxDuration→ STOP ─confirmed→ AWAIT ─over→ FINISHED

Pure: the caller passes times, in seconds of a monotonic clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from detector.actions.trigger.requests import Order, Progress, Report

_FIRST_WAIT = 0.5
_LONGEST_WAIT = 15.0
_POLL = 1.0
"""Seconds between two status requests for a recording that is ending."""

FOREVER = float("inf")


class NextRequest(Enum):
    """The next request."""

    START = "start"
    HOLD = "hold"
    STOP = "stop"
    AWAIT = "await"
    FINISHED = "finished"


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Maximum durations, in seconds."""

    maximum: float
    """Of the recording, if the other system does not end it by itself."""
    give_up: float
    """Of a request that is not confirmed."""
    renew: float | None
    """Until a start is repeated."""


class RemoteRecording:
    """One recording on another system."""

    def __init__(self, order: Order, limits: Timeouts, now: float, onset: float, *, resumed: bool = False) -> None:
        """`onset`: when the condition began; `resumed`: an earlier run of the detector may have requested it."""
        self.order = order
        self._limits = limits
        self.onset = onset
        self.ended: float | None = None
        """When the episode ended."""
        self.step = NextRequest.START
        self.due = now
        """Time of the next request."""
        self.failures = 0
        """Number of consecutive requests that were not confirmed."""
        self.confirmed = resumed
        """Whether the other system has confirmed that it records, or may have confirmed it to an earlier run."""
        self.unanswered = resumed
        """Whether an unconfirmed start may have arrived."""
        self.problem = ""
        """Why it failed; empty if it did not."""
        self.note = ""
        """Further information."""
        self.report = Report(Progress.UNKNOWN)
        """The last report about the recording."""
        self.lost_stop = False
        """Whether the stop was given up."""
        self._since = now
        self._limit = now + limits.maximum

    @property
    def finished(self) -> bool:
        """Whether no request is left."""
        return self.step is NextRequest.FINISHED

    def end(self, now: float, ended: float) -> None:
        """The episode has `ended`, or the recording is no longer wanted."""
        if self.ended is None:
            self.ended = ended
            if self.step is NextRequest.HOLD:
                self._to(NextRequest.STOP, now)

    def next_request(self, now: float) -> NextRequest | None:
        """The request to send now; None: none is due."""
        if self.step is NextRequest.HOLD and now >= self._limit:
            self.note = (
                "the recording reached its maxDuration before the episode ended" if self.ended is None else self.note
            )
            self._to(NextRequest.STOP, now)
        return self.step if now >= self.due and not self.finished else None

    def next_due(self) -> float:
        """When `next_request` may return a request, if nothing happens before."""
        if self.finished:
            return FOREVER
        return min(self.due, self._limit) if self.step is NextRequest.HOLD else self.due

    def failed(self, now: float, why: str, *, silent: bool) -> None:
        """The request was not confirmed; `silent`: there was no response, so it may have arrived nevertheless."""
        self.failures += 1
        self.unanswered = self.unanswered or silent
        self.due = now + min(_FIRST_WAIT * 2 ** min(self.failures - 1, 10), _LONGEST_WAIT)
        if now - self._since < self._limits.give_up or self.step is NextRequest.HOLD:
            return
        if self.step is NextRequest.START:
            self.problem = f"gave up starting the recording: {why}"
            if self.unanswered:
                self._to(NextRequest.STOP, now)  # otherwise it might record for nothing
            else:
                self.step = NextRequest.FINISHED
        elif self.step is NextRequest.STOP:
            self.lost_stop = True
            self.problem = self.problem or f"gave up waiting for the confirmation of the stop: {why}"
            self.step = NextRequest.FINISHED
        else:
            self.note = self.note or f"the result of the recording is unknown: {why}"
            self.step = NextRequest.FINISHED

    def answered(self, now: float, report: Report) -> None:
        """The other system responded to the request that `next_request` returned."""
        if report.progress is Progress.REFUSED and self.step in (NextRequest.START, NextRequest.STOP):
            self.failed(now, report.message, silent=False)
            return
        before = self.report
        if report.progress is not Progress.UNKNOWN:
            self.report = report
        if self.step in (NextRequest.START, NextRequest.HOLD):
            self._started(now, report)
        elif report.progress is Progress.UNKNOWN:
            if self.confirmed and not self.problem:
                self.problem = "the other system restarted and no longer knows the recording, which is incomplete"
            self.step = NextRequest.FINISHED
        elif report.progress.over:
            self._over(report)
        elif self.step is NextRequest.STOP:
            self._to(NextRequest.AWAIT, now)
            self.due = now + _POLL
        else:
            if (report.samples, report.progress) != (before.samples, before.progress):
                self._since = now  # it continues
            self.failures = 0
            self.due = now + _POLL
            if now - self._since >= self._limits.give_up:
                self.failed(now, "the recording did not finish", silent=False)

    def _started(self, now: float, report: Report) -> None:
        if report.progress.over:
            self._over(report)
            return
        self.failures, self._since = 0, now
        self.confirmed, self.unanswered = True, False
        if self.ended is not None:
            self._to(NextRequest.STOP, now)
        else:
            self.step = NextRequest.HOLD
            self.due = FOREVER if self._limits.renew is None else now + self._limits.renew

    def _over(self, report: Report) -> None:
        """The recording has ended there."""
        if report.progress is not Progress.DONE:
            self.problem = self.problem or report.message or "the recording failed on the other system"
        elif self.step in (NextRequest.START, NextRequest.HOLD):
            self.note = report.message or "the recording ended on the other system before the episode ended"
        else:
            self.note = self.note or report.message
        self.step = NextRequest.FINISHED

    def _to(self, step: NextRequest, now: float) -> None:
        self.step, self.due, self.failures, self._since = step, now, 0, now
