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

from detector.actions.base import Action, ActionError, Setting
from detector.actions.episode import Completion, Episode, Outcome, OutcomeState
from detector.actions.journal import Journal
from detector.actions.trigger.course import FOREVER, Course, CourseStep, Timeouts
from detector.actions.trigger.endpoints import HttpEndpoint, OtherDetector
from detector.actions.trigger.orders import Order, Report, System, order_from
from detector.actions.trigger.ros2 import Ros2Services, call_problems
from wayside.api import Detector
from wayside.api.actions import trigger as api
from wayside.api.detector import Clock
from wayside.api.wording import FieldPath
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

    def __init__(self, parameters: api.TriggerAction, setting: Setting) -> None:
        super().__init__(parameters, setting)
        self._system = self._make_system()
        self._limits = Timeouts(
            FOREVER if self._system.ends_by_itself else parameters.maximum_duration.seconds,
            parameters.give_up_after.seconds,
            self._system.renew,
        )
        self._courses: dict[str, Course] = {}
        self._episodes: dict[str, Episode] = {}
        self._reported: dict[str, Outcome] = {}
        self._silent: dict[str, tuple[int, float]] = {}
        """Places that did not respond: the number of consecutive failures, and the time of the next attempt."""
        self._digest = _digest(parameters)
        self._journal = Journal(
            setting, "triggers", "recordings on other systems that a restart would not stop", version=self._digest
        )
        self._left = self._journal.load_all("", order_from)
        """Orders of the previous run that no episode has claimed yet."""
        self._claim = time.monotonic() + _CLAIM

    def started(self, episode: Episode) -> None:
        """Request a recording, or its continuation."""
        if len(self._courses) >= _MOST:
            raise ActionError(
                f"{_MOST} recordings on other systems are already in progress, the maximum: this one is not requested"
            )
        identity = f"{self._prefix}.{encode(episode.id)}"
        left = self._left.pop(identity, None)
        order = Order(identity, self._rendered(episode) if left is None else left.rendered, episode.started)
        self._system.place(order)
        now = time.monotonic()
        onset = now - (0.0 if episode.resumed else self._ago(episode.onset_time, episode.start_time))
        self._courses[identity] = Course(order, self._limits, now, onset, resumed=episode.resumed)
        self._episodes[identity] = episode
        self._journal.put(identity, order.to_json(), sync=True)

    def ended(self, episode: Episode) -> None:
        """Stop the recording of the episode."""
        course = self._courses.get(f"{self._prefix}.{encode(episode.id)}")
        if course is not None and episode.end_time is not None:
            now = time.monotonic()
            course.end(now, now - self._ago(episode.end_time, episode.end_time))

    def completed(self, episode: Episode, completion: Completion) -> None:
        """If the episode has not ended, the recording continues, so that the next run may resume it."""
        identity = f"{self._prefix}.{encode(episode.id)}"
        course = self._courses.get(identity)
        if course is None or course.ended is not None:
            return
        if self.setting.closing.is_set() and self._outlives():
            del self._courses[identity], self._episodes[identity]  # but not in the journal
            message = "it continues: the episode is resumed after the restart, or its maximumDuration ends it"
            self.setting.report(episode, self._outcome(OutcomeState.DONE, course, message))
        else:
            now = time.monotonic()
            course.end(now, now)

    def wake(self) -> float | None:
        """Send the requests that are due, one at a time."""
        now = time.monotonic()
        if self._left and now >= self._claim:
            self._stop_left(now)
        due: list[tuple[float, Course, CourseStep]] = []
        for course in self._courses.values():
            step = course.look(now)
            if step is not None and self._next_attempt(course.order) <= now:
                due.append((course.due, course, step))
        if due:
            self._request(*min(due, key=lambda each: each[0])[1:])
        self._forget_finished()
        if len(due) > 1:
            return 0.0
        nexts = [max(each.next_look(), self._next_attempt(each.order)) for each in self._courses.values()]
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
                course
                for course in self._courses.values()
                if course.look(max(now, course.due)) is CourseStep.STOP and self._next_attempt(course.order) <= now
            ]
            if not stops:
                break
            self._request(stops[0], CourseStep.STOP)
            self._forget_finished()
        if not self._journal.keeps:
            for course in self._courses.values():
                if course.step in (CourseStep.START, CourseStep.STOP):
                    self._lose(course, "the detector is stopping")
        self._courses = {identity: each for identity, each in self._courses.items() if not each.finished}
        for identity, course in self._courses.items():
            problem = course.problem or f"the detector stopped before its {course.step.value} was confirmed"
            state = OutcomeState.DONE if course.step is CourseStep.AWAIT else OutcomeState.FAILED
            self._report(identity, self._outcome(state, course, problem if state is OutcomeState.FAILED else ""))
        self._journal.close()

    @property
    def _prefix(self) -> str:
        """The prefix of ids. It changes with the parameters: an action that replaces another stops its recordings."""
        return f"{encode(self.setting.holder)}.{self.setting.rule.name}.{self.setting.action}.{self._digest}"

    def _make_system(self) -> System:
        if self.parameters.detector is not None:
            return OtherDetector(self.parameters, self.setting.messenger)
        if self.parameters.http is not None:
            return HttpEndpoint(self.parameters, self.setting.closing)
        return Ros2Services(self.parameters, self.setting.messenger, lambda: self.setting.surroundings().types)

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
        if self.setting.surroundings().detector.spec.clock is Clock.WALL:
            reached = time.time_ns()
        return max(0.0, (reached - then) / 1e9)

    def _outlives(self) -> bool:
        """Whether the episode is known after a restart."""
        by_task = any(action.deploy is not None for action in self.setting.rule.spec.actions)
        return by_task or self.setting.surroundings().detector.spec.state is not None

    def _next_attempt(self, order: Order) -> float:
        return self._silent.get(self._system.place(order), (0, 0.0))[1]

    def _request(self, course: Course, step: CourseStep) -> None:
        order, begin = course.order, time.monotonic()
        place = self._system.place(order)
        try:
            report = self._send(course, step, begin)
        except (ActionError, ValueError) as error:
            now = time.monotonic()
            times = self._silent.get(place, (0, 0.0))[0] + 1
            self._silent[place] = times, now + _SILENCES[min(times, len(_SILENCES)) - 1]
            course.failed(now, str(error), silent=True)
            self._report_progress(course, f"{step.value} is not confirmed yet: {error}")
        else:
            self._silent.pop(place, None)
            course.answered(time.monotonic(), report)
            waits = f": {report.message}" if report.message else ""
            self._report_progress(course, f"at {place}: {report.progress.value}{waits}")

    def _send(self, course: Course, step: CourseStep, now: float) -> Report:
        order = course.order
        if step is CourseStep.AWAIT:
            return self._system.status(order)
        if step is CourseStep.STOP:
            return self._system.stop(order, 0.0 if course.ended is None else now - course.ended)
        return self._system.start(order, now - course.onset, again=course.confirmed)

    def _stop_left(self, now: float) -> None:
        """Stop the orders that the previous run could not stop: their episodes ended, or are no longer known."""
        for identity, order in self._left.items():
            course = Course(order, self._limits, now, now, resumed=True)
            course.confirmed = False  # a recording that is no longer known there counts as stopped
            course.step = CourseStep.STOP
            course.end(now, now)
            self._courses[identity] = course
            _log.info("stopping recording %s, which was not stopped before the restart", identity)
        self._left = {}

    def _forget_finished(self) -> None:
        finished = [identity for identity, course in self._courses.items() if course.finished]
        for identity in finished:
            course = self._courses[identity]
            if course.lost_stop:
                self._lose(course, course.problem)
            state = OutcomeState.FAILED if course.problem else OutcomeState.DONE
            self._report(identity, self._outcome(state, course, course.problem or course.note))
            del self._courses[identity]
            self._episodes.pop(identity, None)
            self._reported.pop(identity, None)
        if finished:
            self._journal.drop(finished)

    def _lose(self, course: Course, why: str) -> None:
        what = "recordings on other systems whose stop was not confirmed: their maximumDuration ends them"
        self.setting.lose(what, 1, f"{course.order.id}: {why}")

    def _report_progress(self, course: Course, message: str) -> None:
        if not course.finished:
            self._report(course.order.id, self._outcome(OutcomeState.RUNNING, course, message))

    def _outcome(self, state: OutcomeState, course: Course, message: str) -> Outcome:
        report = course.report
        return Outcome(
            state, message, report.samples, report.bytes, report.missing, report.files, {"recording": course.order.id}
        )

    def _report(self, identity: str, outcome: Outcome) -> None:
        episode = self._episodes.get(identity)
        if episode is not None and self._reported.get(identity) != outcome:
            self._reported[identity] = outcome
            self.setting.report(episode, outcome)


def _digest(parameters: api.TriggerAction) -> str:
    """Eight hexadecimal digits that distinguish versions of the action."""
    return hashlib.sha256(json.dumps(parameters.to_json(), sort_keys=True).encode()).hexdigest()[:8]
