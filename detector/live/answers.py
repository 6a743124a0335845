"""The responses of a running detector to requests: its status, and the result of a rule with onDemand.

Some requests also change something: a rule is paused or resumed; a recording begins or ends.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import asdict
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

import msgspec

from detector.actions.deploy.reconciler import DemandReconciler
from detector.actions.trigger.requests import RECORDINGS
from detector.engine.episodes.plain import plain
from detector.live.evaluator import Evaluator
from detector.live.requested import RequestedRecordings
from detector.live.sink import LiveSink
from detector.sources.supervision import Sources
from detector.status.model import (
    TASK_CHANGES,
    ActionStatus,
    CertificateStatus,
    Drops,
    LeaseStatus,
    RuleExplanation,
    SourceStatus,
    Status,
    TaskStatus,
    to_json,
)
from wayside.times import format_time

if TYPE_CHECKING:
    from detector.actions.deploy.lease import HolderLease

Result = TypeVar("Result")

_PATIENCE = 5.0
"""Seconds to wait for the evaluation."""

_RUNS = 20
"""Maximum number of episodes per action whose last message is shown."""

_SILENT = 30.0
"""Seconds without an evaluation after which it is considered dead; a slow evaluation reports itself."""


class Answers:
    """Responds to requests, on any thread."""

    def __init__(
        self,
        evaluator: Evaluator,
        sink: LiveSink,
        sources: Sources,
        requested: RequestedRecordings,
        loop_silence: Callable[[], float],
        lease: HolderLease | None = None,
    ) -> None:
        """`loop_silence` returns the seconds for which the event loop has not run."""
        self._loop_silence = loop_silence
        self._evaluator = evaluator
        self._sources = sources
        self._requested = requested
        self._sink = sink
        self._lease = lease
        self._answers: Mapping[str, Callable[[Mapping[str, str]], bytes]] = {
            "status": self._status,
            "evaluate": self._evaluate,
            "pause": lambda given: self._pause(given, paused=True),
            "resume": lambda given: self._pause(given, paused=False),
        }

    def answer(self, what: str, given: Mapping[str, str], payload: bytes) -> bytes:
        """The response as JSON. Raises ValueError if there is none; the message gives the reason."""
        if what == RECORDINGS:
            return self._requested.answer(payload)
        answer = self._answers.get(what)
        if answer is None:
            known = ", ".join([*self._answers, RECORDINGS])
            raise ValueError(f"unknown request {what!r}: the detector answers {known}")
        return answer(given)

    def status(self) -> Status:
        """The latest status, with the parts that the engine does not have."""
        latest, sink = self._evaluator.status.latest, self._sink
        dropped = [
            Drops("event_unpublished", "events not published", sink.network.dropped_events),
            Drops("event_unwritten", "events not written to events.jsonl", sink.unwritten),
        ]
        sources = [
            SourceStatus(each.source.name, each.source.plugin, each.state.value, each.messages, each.last_error)
            for each in self._sources.threads
        ]
        actions = [
            ActionStatus(
                which.rule, which.action, counts.kind, counts.running, counts.done, counts.failed, counts.samples,
                counts.missing, counts.bytes, counts.files, counts.last_file, counts.last_failure,
                dict(islice(counts.current.items(), _RUNS)),
            )
            for which, counts in sink.actions.outcomes.counts_by_action().items()
        ]  # fmt: skip
        return msgspec.structs.replace(
            latest,
            connected=sink.network.connected,
            certificate=CertificateStatus(**asdict(sink.network.certificate_state)),
            drops=[*latest.drops, *dropped],
            sources=sources,
            actions=actions,
            tasks=reconciler_status(sink.reconciler),
            lease=None if self._lease is None else lease_status(self._lease),
        )

    def healthy(self) -> tuple[bool, bytes]:
        """Whether everything runs that only a restart can repair, for /healthz."""
        silent, hung, dead = self._evaluator.status.silence, self._loop_silence(), self._sink.network.dead
        lines = [f"the last evaluation was {silent:.1f} s ago"]
        if hung >= _SILENT:
            lines.append(f"the event loop has been blocked for {hung:.1f} s: tasks and the Lease are not updated")
        if dead is not None:
            lines.append(f"receiving has stopped: {dead}")
        return silent < _SILENT and hung < _SILENT and dead is None, "".join(f"{line}\n" for line in lines).encode()

    def ready(self) -> tuple[bool, bytes]:
        """Whether samples can arrive and be evaluated, for /readyz.

        A listening detector is ready without connections: otherwise no Service would route to it.
        """
        well, text = self.healthy()
        network = self._sink.network
        if not network.joined:
            return False, text + b"no Zenoh session yet\n"
        if not network.listens and not network.connected:
            return False, text + b"nothing is connected on Zenoh: reconnecting, the buffer is kept\n"
        return well, text

    def _status(self, given: Mapping[str, str]) -> bytes:
        status = self.status()
        rule = given.get("rule")
        if rule is None:
            return to_json(status)
        rules = [each for each in status.rules if each.name == rule]
        if not rules:
            known = ", ".join(each.name for each in status.rules) or "none"
            raise ValueError(f"detector {status.holder} has no rule {rule}; it has {known}")
        explanation = self._explanation(rule, given.get("subject"), given.get("wait", "1"))
        return to_json(msgspec.structs.replace(status, rules=rules, explanation=explanation))

    def _evaluate(self, given: Mapping[str, str]) -> bytes:
        """A list with an entry for each subject; times are RFC 3339."""
        rule = _rule(given)
        answers = self._in_time(self._evaluator.evaluate_rule(rule))
        return msgspec.json.encode(
            [
                {
                    "subject": answer.subject,
                    "when": answer.when,
                    "values": plain(answer.values),
                    "episode": None if answer.episode is None else answer.episode.id,
                    "startTime": None if answer.episode is None else format_time(answer.episode.start_time),
                }
                for answer in answers
            ]
        )

    def _pause(self, given: Mapping[str, str], *, paused: bool) -> bytes:
        rule = _rule(given)
        self._in_time(self._evaluator.pause_rule(rule, paused))
        return msgspec.json.encode({"rule": rule, "paused": paused})

    def _in_time(self, future: Future[Result]) -> Result:
        try:
            return future.result(_PATIENCE)
        except TimeoutError:
            raise ValueError(f"the evaluation did not respond within {_PATIENCE:g} s: it is overloaded") from None

    def _explanation(self, rule: str, subject: str | None, wait: str) -> RuleExplanation | None:
        """The values that the rule's next evaluation reads; None if there is none within `wait` seconds."""
        if not re.fullmatch(r"[0-9]{1,2}(\.[0-9]{1,3})?", wait):
            raise ValueError(f"wait must be a number of seconds below 100, e.g. wait=2.5; got {wait}")
        watching = None
        try:
            watching = self._evaluator.call(lambda: self._evaluator.status.watch(rule, subject)).result(_PATIENCE)
            return watching.result(float(wait))
        except ValueError as error:
            return RuleExplanation(0.0, [], [str(error)])
        except TimeoutError:
            return None
        finally:
            if watching is not None:
                watching.cancel()


def reconciler_status(reconciler: DemandReconciler) -> TaskStatus:
    """The counts of the reconciler."""
    counts = reconciler.counts
    return TaskStatus(
        **{name: getattr(counts, name) for name in (*TASK_CHANGES, "retried")},
        refused=dict(counts.refused),
        pending=reconciler.pending,
    )


def lease_status(lease: HolderLease) -> LeaseStatus:
    """The state of the holder's Lease."""
    return LeaseStatus(lease.held.is_set(), lease.attempts, lease.failures)


def _rule(given: Mapping[str, str]) -> str:
    rule = given.get("rule")
    if not rule:
        raise ValueError("rule is missing: give ?rule=NAME")
    return rule
