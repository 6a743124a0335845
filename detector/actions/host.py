"""Runs the actions of all rules, follows changes of the rules, and stops them cleanly.

engine ─▶ consequences ─▶ host ─▶ a worker with a separate thread for each action of each rule
                                      └▶ outcomes: status, progress events on Zenoh
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from detector.actions.base import Action, ActionContext, DetectorConfiguration, Messenger
from detector.actions.outcomes import ActionKey, Outcomes
from detector.actions.registry import DEPLOY, prepare_action
from detector.actions.worker import MAXIMUM_BYTES, Worker
from detector.engine.consequences import ActionRun, Consequence, RunStarted
from wayside.api import EventRule
from wayside.api.actions import action as api

_log = logging.getLogger(__name__)

_GRACE = 5.0
"""Seconds that actions have to finish at the end."""


@dataclass(slots=True)
class _Assignment:
    """A worker, and the action that it runs."""

    rule: EventRule
    action: api.ActionSpec
    worker: Worker


class ActionHost:
    """The workers. `follow` and `dispatch` are called by one thread, the evaluation's, and never wait."""

    def __init__(
        self,
        holder: str,
        messenger: Messenger,
        *,
        now: Callable[[], int] = time.time_ns,
        maximum_bytes: int = MAXIMUM_BYTES,
        patient: bool = False,
    ) -> None:
        """`maximum_bytes` of samples are queued for each action; `now` returns nanoseconds since the epoch.

        `patient`: `dispatch` waits for an action that is too slow. Otherwise samples are dropped.
        """
        self._patient = patient
        self._holder = holder
        self._messenger = messenger
        self._maximum = maximum_bytes
        self._configuration: DetectorConfiguration | None = None
        self._closing = threading.Event()
        self._assignments: dict[ActionKey, _Assignment] = {}
        self._at_work: dict[ActionRun, Worker] = {}
        self._leaving: list[Worker] = []
        """Workers whose action was changed or removed; each ends when it has completed its runs."""
        self.outcomes = Outcomes(holder, messenger.publish, now)

    def follow(self, rules: Iterable[EventRule], configuration: DetectorConfiguration) -> None:
        """Use these rules from now on. Unchanged actions continue; others finish their running episodes."""
        self._configuration = configuration
        wanted = {
            ActionKey(rule.name, action.name): (rule, action)
            for rule in rules
            for action in rule.spec.actions
            if action.field != DEPLOY
        }
        for which, assignment in list(self._assignments.items()):
            if which not in wanted or not _same(assignment, *wanted[which]):
                del self._assignments[which]
                self._leaving.append(assignment.worker)
        for which, (rule, action) in wanted.items():
            if which not in self._assignments:
                self.outcomes.register(which, action.kind)
                worker = Worker(which, self._maker(rule, action), self.outcomes, self._maximum, patient=self._patient)
                self._assignments[which] = _Assignment(rule, action, worker)
        self._dismiss()

    def dispatch(self, consequences: Sequence[Consequence]) -> None:
        """Pass the consequences to the workers, in order."""
        for each in consequences:
            if isinstance(each, RunStarted):
                assignment = self._assignments.get(ActionKey(each.run.rule, each.run.action))
                if assignment is None:
                    continue
                self._at_work[each.run] = assignment.worker
            worker = self._at_work.get(each.run)
            if worker is not None:
                worker.enqueue(each)
                if each.run not in worker.open:
                    del self._at_work[each.run]
        if consequences:
            self._dismiss()

    def close(self, grace: float = _GRACE) -> None:
        """End all workers; returns when they have ended, or after `grace` seconds, and logs those that have not."""
        self._closing.set()
        workers = [*(each.worker for each in self._assignments.values()), *self._leaving]
        for worker in workers:
            worker.request_close()
        deadline = time.monotonic() + grace
        for worker in workers:
            if not worker.join(max(0.0, deadline - time.monotonic())):
                rule, action = worker.which
                _log.error(
                    "action %s of EventRule %s did not stop within %g s; abandoning its thread", action, rule, grace
                )
                self.outcomes.lose(
                    worker.which, "times the action did not stop in time, so that its thread was abandoned", 1, ""
                )

    def _dismiss(self) -> None:
        """Close workers that have no work left."""
        for worker in self._leaving:
            if not worker.open:
                worker.request_close()
        self._leaving = [worker for worker in self._leaving if not worker.ended]

    def _maker(self, rule: EventRule, action: api.ActionSpec) -> Callable[[], Action[Any]]:
        which = ActionKey(rule.name, action.name)
        context = ActionContext(
            rule=rule,
            action=action.name,
            holder=self._holder,
            configuration=self._current_configuration,
            messenger=self._messenger,
            report=partial(self.outcomes.report, which),
            lose=partial(self.outcomes.lose, which),
            closing=self._closing,
        )

        def make() -> Action[Any]:
            offered, parameters = prepare_action(action)
            return offered(parameters, context)

        return make

    def _current_configuration(self) -> DetectorConfiguration:
        if self._configuration is None:
            raise RuntimeError("no EventRule has been applied yet")
        return self._configuration


def _same(assignment: _Assignment, rule: EventRule, action: api.ActionSpec) -> bool:
    """Whether the action is unchanged. The labels and texts of its rule go into recordings, so they count."""
    before = assignment.rule
    return (
        assignment.action == action
        and before.metadata.generation == rule.metadata.generation
        and before.metadata.labels == rule.metadata.labels
        and before.spec.classification == rule.spec.classification
        and before.spec.description == rule.spec.description
    )
