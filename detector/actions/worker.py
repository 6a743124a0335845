"""Runs one action of one rule: its thread, and the bounded queue of its input.

Samples are queued up to a number of bytes; beyond it they are dropped from that run, counted, and reported at its end.
Messages about episodes are never dropped. An exception ends the action's work for that episode and no other.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from msgspec.structs import astuple, replace

from detector.actions.base import Action, ActionError
from detector.actions.episode import Completion, Episode, Outcome, OutcomeState
from detector.actions.outcomes import ActionKey, Outcomes
from detector.engine.consequences import (
    ActionRun,
    Consequence,
    EpisodeEnded,
    RunCompleted,
    RunSamples,
    RunStarted,
)
from detector.engine.samples.sample import SAMPLE_OVERHEAD

_log = logging.getLogger(__name__)

MAXIMUM_BYTES = 256 * 2**20
"""Maximum size of the samples that are queued for an action, overhead included."""

SILENT = "the action ended without reporting an outcome"

_AGAIN = 1.0
"""Seconds after which a failed `wake` is called again."""

Make = Callable[[], Action[Any]]
"""Creates the action, on its own thread: that may take time, and may raise any exception."""


class Worker:
    """Passes episodes to an action. Only one thread at a time calls `enqueue`, which never waits unless `patient`."""

    def __init__(
        self,
        which: ActionKey,
        make: Make,
        outcomes: Outcomes,
        maximum_bytes: int = MAXIMUM_BYTES,
        *,
        patient: bool = False,
    ) -> None:
        """`patient`: `enqueue` waits while the queue is full, and no sample is dropped."""
        self.which = which
        self._patient = patient
        self._make = make
        self._outcomes = outcomes
        self._maximum = maximum_bytes
        self._inbox: deque[tuple[Consequence, int]] = deque()
        """The queued messages, each with the bytes of its samples."""
        self._waiting = 0
        self._missing: dict[ActionRun, int] = {}
        self._changed = threading.Condition()
        self._closing = False
        self._episodes: dict[ActionRun, Episode] = {}
        """The episodes of the runs that the action receives."""
        self._completed: list[Episode] = []
        """Completed episodes about which the action has not reported anything yet."""
        self.open: set[ActionRun] = set()
        """The runs that are not completed, from the producer's point of view."""
        self._thread = threading.Thread(target=self._work, name=f"action {which.rule}/{which.action}", daemon=True)
        self._thread.start()

    def enqueue(self, consequence: Consequence) -> None:
        """Enqueue a message; see `patient`."""
        match consequence:
            case RunStarted(run=run):
                self.open.add(run)
            case RunCompleted(run=run):
                self.open.discard(run)
        size = 0
        if isinstance(consequence, RunSamples):
            size = sum(len(sample.payload) + SAMPLE_OVERHEAD for sample in consequence.samples)
        with self._changed:
            if self._patient:
                self._changed.wait_for(lambda: not self._waiting or self._waiting + size <= self._maximum)
            elif size and self._waiting + size > self._maximum:
                count = len(consequence.samples) if isinstance(consequence, RunSamples) else 0
                self._missing[consequence.run] = self._missing.get(consequence.run, 0) + count
                self._outcomes.lose(self.which, "samples left out because the action is too slow", count, "")
                return
            self._waiting += size
            self._inbox.append((consequence, size))
            self._changed.notify()

    def request_close(self) -> None:
        """Accept no further messages; returns at once."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def join(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds for the end of the action; returns whether it has ended."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    @property
    def ended(self) -> bool:
        """Whether the thread has ended."""
        return not self._thread.is_alive()

    def _work(self) -> None:
        action, problem = self._made()
        due: float | None = 0.0  # at once: it may have unfinished work from a previous run
        while True:
            with self._changed:
                if not self._inbox and not self._closing:
                    self._changed.wait(None if due is None else max(0.0, due - time.monotonic()))
                received = list(self._inbox)
                self._inbox.clear()
                closing = self._closing
            for consequence, size in received:
                self._pass_on(action, problem, consequence)
                with self._changed:
                    self._waiting -= size
                    self._changed.notify()
            if action is not None and (received or closing or due is None or time.monotonic() >= due):
                due = self._woken(action)
            if closing and not received:
                break
        if action is not None:
            try:
                action.close()
            except Exception as error:  # noqa: BLE001  third-party code, in its last call
                self._failed_in(action, "close", error)
            for episode in self._silent():
                self._outcomes.report(self.which, episode, Outcome(OutcomeState.FAILED, SILENT))

    def _made(self) -> tuple[Action[Any] | None, str]:
        try:
            return self._make(), ""
        except Exception as error:  # noqa: BLE001  third-party code: only its episodes fail
            problem = f"cannot create the action: {_text(error)}"
            _log.error("action %s of EventRule %s: %s", self.which.action, self.which.rule, problem)
            return None, problem

    def _pass_on(self, action: Action[Any] | None, problem: str, consequence: Consequence) -> None:
        run = consequence.run
        if isinstance(consequence, RunStarted):
            episode = _episode(consequence)
            self._episodes[run] = episode
            self._outcomes.begin(self.which, episode)
            if action is None:
                self._fail(run, problem)
        if action is None or run not in self._episodes:
            return
        try:
            self._call(action, consequence)
        except Exception as error:  # noqa: BLE001  any exception is the failure of this run only
            if not isinstance(error, ActionError):
                _log.debug("action %s of EventRule %s", self.which.action, self.which.rule, exc_info=error)
            self._fail(run, _text(error))
        if isinstance(consequence, RunCompleted):
            completed = self._episodes.pop(run, None)
            self._completed = [*self._silent(), *(() if completed is None else (completed,))]

    def _silent(self) -> list[Episode]:
        return [each for each in self._completed if self._outcomes.is_silent(self.which, each.id)]

    def _call(self, action: Action[Any], consequence: Consequence) -> None:
        run = consequence.run
        episode = self._episodes[run]
        match consequence:
            case RunStarted():
                action.started(episode)
            case RunSamples(samples=samples):
                action.samples(episode, samples)
            case EpisodeEnded(event=event):
                reason = None if event.reason is None else event.reason.value
                ended = replace(episode, end_time=event.end_time, reason=reason, ended=event.cloud_event())
                if (again := event.rendered.get(run.action)) is not None:
                    ended = replace(ended, rendered={**ended.rendered, **again.values}, rendered_again=True)
                self._episodes[run] = ended
                action.ended(ended)
            case RunCompleted(cut=cut):
                with self._changed:
                    missing = self._missing.pop(run, 0)
                action.completed(episode, Completion(cut, missing))

    def _fail(self, run: ActionRun, why: str) -> None:
        """The action failed with the run, which receives no further calls."""
        episode = self._episodes.pop(run)
        if self._outcomes.is_open(self.which, episode.id):
            _log.error("action %s of EventRule %s failed for %s: %s", self.which.action, run.rule, episode.subject, why)
            with self._changed:
                missing = self._missing.pop(run, 0)
            self._outcomes.report(self.which, episode, Outcome(OutcomeState.FAILED, why, missing=missing))

    def _woken(self, action: Action[Any]) -> float | None:
        """When to call it again; seconds of the monotonic clock."""
        try:
            pause = action.wake()
        except Exception as error:  # noqa: BLE001  third-party code, which must not end the thread
            self._failed_in(action, "wake", error)
            pause = _AGAIN
        return None if pause is None else time.monotonic() + max(0.0, pause)

    def _failed_in(self, action: Action[Any], where: str, error: Exception) -> None:
        what = f"times {type(action).__name__}.{where} failed"
        self._outcomes.lose(self.which, what, 1, _text(error))
        _log.error("action %s of EventRule %s: %s: %s", self.which.action, self.which.rule, where, _text(error))
        _log.debug("in %s", where, exc_info=error)


def _text(error: Exception) -> str:
    if isinstance(error, ActionError):
        return str(error)
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _episode(begun: RunStarted) -> Episode:
    return Episode(
        *astuple(begun.event.episode),
        rendered=begun.rendered.values,
        unrendered=begun.rendered.problems,
        started=begun.event.cloud_event(),
        resumed=begun.resumed,
    )
