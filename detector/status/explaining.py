"""Explains why a rule fires or not: the values that its next evaluation reads for each subject.

The evaluation is observed, not repeated: it reports its intermediate values, so observing changes no result and nothing
is computed in addition.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from typing import Any

from detector.engine.buffering.buffer import NEVER
from detector.engine.engine import Engine
from detector.engine.episodes.plain import plain
from detector.engine.scoping.scopes import Evaluated
from detector.engine.scoping.snapshots import snapshot
from detector.status.model import RuleExplanation, SubjectStatus
from wayside.expressions import UNKNOWN
from wayside.names import parse_subject
from wayside.rules import ClientSubject, FleetSubject, PairSubject

MAXIMUM_SUBJECTS = 20
"""Maximum number of subjects shown, those with an open episode or a true condition first."""

_MAXIMUM_NOTES = 20


class RuleWatch:
    """Watches one rule until it has been evaluated. Only for the evaluation thread."""

    def __init__(self, engine: Engine, rule: str, subject: str | None) -> None:
        """Raises ValueError if the rule does not exist, or is watched already."""
        run = engine.rules.get(rule)
        if run is None:
            raise ValueError(f"rule {rule} is not evaluated: see its state and message")
        if run.on_evaluated is not None:
            raise ValueError(f"another request about rule {rule} is in progress: try again")
        self.future: Future[RuleExplanation] = Future()
        self._engine = engine
        self._run = run
        self._subject = subject
        self._ticks = run.counters.ticks
        self._seen: list[tuple[int, SubjectStatus]] = []
        run.on_evaluated = self._record
        run.counters.notes = []

    def is_over(self) -> bool:
        """Whether the rule was evaluated or removed, or the caller no longer waits; then the future is set."""
        gone = self._engine.rules.get(self._run.rule.name) is not self._run
        if self._run.counters.ticks == self._ticks and not gone and not self.future.cancelled():
            return False
        notes, self._run.on_evaluated, self._run.counters.notes = self._run.counters.notes or [], None, None
        if self.future.set_running_or_notify_cancel():
            tick = self._run.counters.last_tick / 1e9
            self.future.set_result(RuleExplanation(tick, self._statuses(), [*dict.fromkeys(notes)][:_MAXIMUM_NOTES]))
        return True

    def _statuses(self) -> list[SubjectStatus]:
        statuses = [status for _, status in sorted(self._seen, key=lambda each: (each[0], each[1].subject))]
        if self._subject is not None and not statuses:
            return [SubjectStatus(self._subject, evaluated=False, why=self._why_not(self._subject))]
        return statuses[:MAXIMUM_SUBJECTS]

    def _record(self, evaluated: Evaluated) -> None:
        text, variables = evaluated.candidate.subject.text, evaluated.candidate.variables
        if self._subject not in (None, text):
            return
        order = 0 if evaluated.is_open else 1 if evaluated.when is True else 2
        status = SubjectStatus(
            subject=text,
            evaluated=True,
            in_scope=_plain(evaluated.candidate.in_scope),
            near=_plain(evaluated.candidate.near),
            when=_plain(evaluated.when),
            until=_plain(evaluated.until),
            open=evaluated.is_open,
            pending=None if evaluated.onset is None else (evaluated.now - evaluated.onset) / 1e9,
            values=plain(snapshot(self._run.rule, evaluated.candidate)),
            unknown=dict(self._unknowns(variables)),
        )
        self._seen.append((order, status))

    def _unknowns(self, variables: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """By signal, as named in expressions, why it has no value."""
        for plugin in self._run.rule.plugins:
            if plugin.name not in variables:
                yield (
                    plugin.name,
                    f"plugin {plugin.plugin} returned no value or failed: see the last error of the rule",
                )
        match self._run.rule.subject:
            case PairSubject():
                for role in ("a", "b"):
                    yield from ((f"{role}.{name}", why) for name, why in self._of_view(variables[role]))
            case ClientSubject():
                yield from self._of_view(variables)
            case FleetSubject():
                return

    def _of_view(self, view: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        rule, client = self._run.rule, view["client"]
        for signal in rule.signals:
            if signal.name not in view:
                yield signal.name, self._of_stream(signal.client or client, signal.stream)
        for model in rule.models:
            if model.name not in view:
                yield model.name, "an input of the model is unknown, or the model failed"
        if isinstance(rule.subject, PairSubject) and "position" not in view:
            yield "position", self._of_stream(client, rule.subject.position.stream)

    def _of_stream(self, client: str, stream: str) -> str:
        lane = self._engine.buffer.lane(client, stream)
        spec = self._engine.detector.spec.stream(stream)
        if spec is None:
            return f"no {stream} has such a value"
        if lane is None or lane.latest == NEVER:
            return f"no sample of stream {stream} has arrived from {client}"
        age = (self._engine.now - lane.latest) / 1e9
        limit = self._engine.detector.spec.stale_after_ns(spec)
        if limit is not None and age > limit / 1e9:
            return f"stream {stream} of {client} is stale: its newest sample is {age:.1f} s old, more than staleAfter"
        return f"the samples of stream {stream} from {client} have no such value in the window"

    def _why_not(self, text: str) -> str:
        try:
            clients, _ = parse_subject(text)
        except ValueError:
            return f"the subject must be like car1, car1+car2 or ~fleet, or with an element car1~north; got {text!r}"
        missing = [client for client in clients if client not in self._engine.clients]
        if missing:
            return f"unknown client {missing[0]}: no sample arrived from it within clientTimeout"
        match self._run.rule.subject:
            case PairSubject() as pairs if len(clients) == 2:
                return f"the pair is not within {pairs.within:g} m, or a position is unknown, or a role does not match"
            case PairSubject():
                return "the rule is about pairs: write car1+car2"
            case FleetSubject():
                return "the rule is about the fleet: write ~fleet"
            case ClientSubject():
                return (
                    "the rule is about single clients, or their elements where it has `each`: write car1 or car1~north"
                )


def _plain(truth: Any) -> bool | None:
    return None if truth is UNKNOWN else truth
