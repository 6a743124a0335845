"""The action: a state machine per episode, and one request at a time.

Requests wait for the network, on the action's own thread. While a system does not respond, all requests to it are
delayed, so that an unavailable system costs one timeout at a time and not one per episode.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Iterable, Mapping
from typing import Any

from detector.actions.base import Action, ActionContext, ActionError
from detector.actions.episode import Completion, Episode, Outcome, OutcomeState
from detector.actions.journal import Journal
from detector.actions.trigger.endpoints import HttpEndpoint, OtherDetector
from detector.actions.trigger.requests import Order, RecordingSystem, Report, order_from
from detector.actions.trigger.ros2 import Ros2Services, call_problems
from detector.actions.trigger.state_machine import FOREVER, NextRequest, RemoteRecording, Timeouts
from wayside.api import Detector
from wayside.api.actions import trigger as api
from wayside.api.detector import Clock
from wayside.api.validation_errors import FieldPath
from wayside.names import encode

_log = logging.getLogger(__name__)

_MOST = 1000
"""Maximum number of concurrent recordings; those of further episodes are refused."""

_SILENCES = (1.0, 2.0, 5.0, 10.0)
"""Backoff in seconds for a system that does not respond; the last value repeats."""

_CLAIM = 3.0
"""Seconds after the start in which an episode of the previous run may be resumed."""

_LEAVE = 2.0
"""Seconds at the end for the remaining stop requests."""


class Trigger(Action[api.TriggerAction]):
    """Makes another system record while an episode lasts."""

    Parameters = api.TriggerAction

    @classmethod
    def problems(cls, parameters: api.TriggerAction, detector: Detector) -> Iterable[tuple[FieldPath, str]]:
        """Unknown services, and requests that do not match."""
        return call_problems(parameters, detector)

    def __init__(self, parameters: api.TriggerAction, context: ActionContext) -> None:
        super().__init__(parameters, context)
        self._system = self._make_system()
        self._limits = Timeouts(
            FOREVER if self._system.ends_by_itself else parameters.max_duration.seconds,
            parameters.give_up_after.seconds,
            self._system.renew,
        )
        self._recordings: dict[str, RemoteRecording] = {}
        self._episodes: dict[str, Episode] = {}
        self._reported: dict[str, Outcome] = {}
        self._silent: dict[str, tuple[int, float]] = {}
        """Places that did not respond: the number of consecutive failures, and the time of the next attempt."""
        self._digest = _digest(parameters)
        self._journal = Journal(
            context, "triggers", "recordings on other systems that a restart would not stop", version=self._digest
        )
        self._left = self._journal.load_all("", order_from)
        """Orders of the previous run that no episode has claimed yet."""
        self._claim = time.monotonic() + _CLAIM

    def started(self, episode: Episode) -> None:
        """Request a recording, or its continuation."""
        if len(self._recordings) >= _MOST:
            raise ActionError(
                f"{_MOST} recordings on other systems are already in progress, the maximum: this one is not requested"
            )
        identity = f"{self._prefix}.{encode(episode.id)}"
        left = self._left.pop(identity, None)
        order = Order(identity, self._rendered(episode) if left is None else left.rendered, episode.started)
        self._system.place(order)
        now = time.monotonic()
        onset = now - (0.0 if episode.resumed else self._ago(episode.onset_time, episode.start_time))
        self._recordings[identity] = RemoteRecording(order, self._limits, now, onset, resumed=episode.resumed)
        self._episodes[identity] = episode
        self._journal.put(identity, order.to_json(), sync=True)

    def ended(self, episode: Episode) -> None:
        """Stop the recording of the episode."""
        recording = self._recordings.get(f"{self._prefix}.{encode(episode.id)}")
        if recording is not None and episode.end_time is not None:
            now = time.monotonic()
            recording.end(now, now - self._ago(episode.end_time, episode.end_time))

    def completed(self, episode: Episode, completion: Completion) -> None:
        """If the episode has not ended, the recording continues, so that the next run may resume it."""
        identity = f"{self._prefix}.{encode(episode.id)}"
        recording = self._recordings.get(identity)
        if recording is None or recording.ended is not None:
            return
        if self.context.closing.is_set() and self._outlives():
            del self._recordings[identity], self._episodes[identity]  # but not in the journal
            message = "the recording continues until the restarted detector stops it, or until its maxDuration"
            self.context.report(episode, self._outcome(OutcomeState.DONE, recording, message))
        else:
            now = time.monotonic()
            recording.end(now, now)

    def wake(self) -> float | None:
        """Send the requests that are due, one at a time."""
        now = time.monotonic()
        if self._left and now >= self._claim:
            self._stop_left(now)
        due: list[tuple[float, RemoteRecording, NextRequest]] = []
        for recording in self._recordings.values():
            step = recording.next_request(now)
            if step is not None and self._next_attempt(recording.order) <= now:
                due.append((recording.due, recording, step))
        if due:
            self._request(*min(due, key=lambda each: each[0])[1:])
        self._forget_finished()
        if len(due) > 1:
            return 0.0
        nexts = [max(each.next_due(), self._next_attempt(each.order)) for each in self._recordings.values()]
        nexts += [self._claim] if self._left else []
        soonest = min(nexts, default=FOREVER)
        return None if soonest == FOREVER else max(0.0, soonest - time.monotonic())

    def close(self) -> None:
        """Stop recordings that nothing stops later, as far as this is quick."""
        end = time.monotonic() + _LEAVE
        self._system.timeout = min(self._system.timeout, 1.0)
        while time.monotonic() < end:
            now = time.monotonic()
            stops = [
                recording
                for recording in self._recordings.values()
                if recording.next_request(max(now, recording.due)) is NextRequest.STOP
                and self._next_attempt(recording.order) <= now
            ]
            if not stops:
                break
            self._request(stops[0], NextRequest.STOP)
            self._forget_finished()
        if not self._journal.is_durable:
            for recording in self._recordings.values():
                if recording.step in (NextRequest.START, NextRequest.STOP):
                    self._lose(recording, "the detector is stopping")
        self._recordings = {identity: each for identity, each in self._recordings.items() if not each.finished}
        for identity, recording in self._recordings.items():
            problem = recording.problem or f"the detector stopped before its {recording.step.value} was confirmed"
            state = OutcomeState.DONE if recording.step is NextRequest.AWAIT else OutcomeState.FAILED
            self._report(identity, self._outcome(state, recording, problem if state is OutcomeState.FAILED else ""))
        self._journal.close()

    @property
    def _prefix(self) -> str:
        """The prefix of ids. It changes with the parameters: an action that replaces another stops its recordings."""
        return f"{encode(self.context.holder)}.{self.context.rule.name}.{self.context.action}.{self._digest}"

    def _make_system(self) -> RecordingSystem:
        if self.parameters.detector is not None:
            return OtherDetector(self.parameters, self.context.messenger)
        if self.parameters.http is not None:
            return HttpEndpoint(self.parameters, self.context.closing)
        return Ros2Services(self.parameters, self.context.messenger, lambda: self.context.configuration().types)

    def _rendered(self, episode: Episode) -> Mapping[str, Any]:
        """The rendered templates; for a resumed episode, those that need no values of its start."""
        if not episode.unrendered:
            return episode.rendered
        templates = self.parameters.templates
        if episode.resumed and "${" not in json.dumps(templates):
            return templates
        name, why = next(iter(episode.unrendered.items()))
        raise ActionError(f"{name}: {why}")

    def _ago(self, then: int, reached: int) -> float:
        """Seconds since `then`; with clock Data up to `reached`, because that time axis differs from ours."""
        if self.context.configuration().detector.spec.clock is Clock.WALL:
            reached = time.time_ns()
        return max(0.0, (reached - then) / 1e9)

    def _outlives(self) -> bool:
        """Whether the episode is known after a restart."""
        by_task = any(action.deploy is not None for action in self.context.rule.spec.actions)
        return by_task or self.context.configuration().detector.spec.state is not None

    def _next_attempt(self, order: Order) -> float:
        return self._silent.get(self._system.place(order), (0, 0.0))[1]

    def _request(self, recording: RemoteRecording, step: NextRequest) -> None:
        order, begin = recording.order, time.monotonic()
        place = self._system.place(order)
        try:
            report = self._send(recording, step, begin)
        except (ActionError, ValueError) as error:
            now = time.monotonic()
            times = self._silent.get(place, (0, 0.0))[0] + 1
            self._silent[place] = times, now + _SILENCES[min(times, len(_SILENCES)) - 1]
            recording.failed(now, str(error), silent=True)
            self._report_progress(recording, f"{step.value} is not confirmed yet: {error}")
        else:
            self._silent.pop(place, None)
            recording.answered(time.monotonic(), report)
            waits = f": {report.message}" if report.message else ""
            self._report_progress(recording, f"at {place}: {report.progress.value}{waits}")

    def _send(self, recording: RemoteRecording, step: NextRequest, now: float) -> Report:
        order = recording.order
        if step is NextRequest.AWAIT:
            return self._system.status(order)
        if step is NextRequest.STOP:
            return self._system.stop(order, 0.0 if recording.ended is None else now - recording.ended)
        return self._system.start(order, now - recording.onset, again=recording.confirmed)

    def _stop_left(self, now: float) -> None:
        """Stop the orders that the previous run could not stop: their episodes ended, or are no longer known."""
        for identity, order in self._left.items():
            recording = RemoteRecording(order, self._limits, now, now, resumed=True)
            recording.confirmed = False  # a recording that is no longer known there counts as stopped
            recording.step = NextRequest.STOP
            recording.end(now, now)
            self._recordings[identity] = recording
            _log.info("stopping recording %s, which was not stopped before the restart", identity)
        self._left = {}

    def _forget_finished(self) -> None:
        finished = [identity for identity, recording in self._recordings.items() if recording.finished]
        for identity in finished:
            recording = self._recordings[identity]
            if recording.lost_stop:
                self._lose(recording, recording.problem)
            state = OutcomeState.FAILED if recording.problem else OutcomeState.DONE
            self._report(identity, self._outcome(state, recording, recording.problem or recording.note))
            del self._recordings[identity]
            self._episodes.pop(identity, None)
            self._reported.pop(identity, None)
        if finished:
            self._journal.drop(finished)

    def _lose(self, recording: RemoteRecording, why: str) -> None:
        what = "recordings on other systems whose stop was not confirmed: their maxDuration ends them"
        self.context.lose(what, 1, f"{recording.order.id}: {why}")

    def _report_progress(self, recording: RemoteRecording, message: str) -> None:
        if not recording.finished:
            self._report(recording.order.id, self._outcome(OutcomeState.RUNNING, recording, message))

    def _outcome(self, state: OutcomeState, recording: RemoteRecording, message: str) -> Outcome:
        report = recording.report
        return Outcome(
            state,
            message,
            report.samples,
            report.bytes,
            report.missing,
            report.files,
            {"recording": recording.order.id},
        )

    def _report(self, identity: str, outcome: Outcome) -> None:
        episode = self._episodes.get(identity)
        if episode is not None and self._reported.get(identity) != outcome:
            self._reported[identity] = outcome
            self.context.report(episode, outcome)


def _digest(parameters: api.TriggerAction) -> str:
    """Eight hexadecimal digits that distinguish versions of the action."""
    return hashlib.sha256(json.dumps(parameters.to_json(), sort_keys=True).encode()).hexdigest()[:8]
