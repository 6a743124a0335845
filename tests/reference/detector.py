"""The reference detector: arrivals in, events out; at each tick everything is recomputed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from tests.reference.aggregates import NOTHING
from tests.reference.derived import Evaluations
from tests.reference.episodes import Break, Episode, Observation, Truth, episodes, in_progress, wakes
from tests.reference.samples import SECOND, Received, Sample
from tests.reference.scopes import Subject, SubjectView, both, looks, text
from tests.reference.signals import Sources, Start, nanoseconds, of_rule, truth


@dataclass(frozen=True)
class Reported:
    """An event. Times are nanoseconds; `reason` is empty for a start."""

    rule: str
    subject: str
    time: int
    onset: int
    reason: str
    values: dict[str, Any]


@dataclass
class Rule:
    """A rule as written, with all observations of its subjects."""

    name: str
    spec: dict[str, Any]
    history: dict[Subject, list[Observation | Break]] = field(default_factory=dict)
    looked: dict[str, list[int]] = field(default_factory=dict)
    """The ticks at which a client was looked at since it is known."""
    evaluations: dict[Subject, Evaluations] = field(default_factory=dict)
    """Of the subjects that were evaluated since their clients are known."""

    @property
    def derived(self) -> list[dict[str, Any]]:
        """The signals over what conditions see."""
        found = [each for each in self.spec.get("signals", []) if "of" in each or each.get("over") == "Episode"]
        if "margin" not in self.spec:
            return found
        margin = {"name": "margin", "margin": self.spec["when"], "scales": self.spec["margin"]}
        reading = [each for each in found if "margin" in each.get("of", "")]
        return [*(each for each in found if each not in reading), margin, *reading]

    def in_progress(self, subject: Subject, client_timeout: int) -> bool:
        """Whether the subject has an episode, or is about to."""
        return in_progress(self.history.get(subject, []), *self._times(client_timeout))

    @property
    def every(self) -> int:
        """Its period."""
        return nanoseconds(self.spec.get("evaluation", {}).get("every", "1s"))

    @property
    def on_sample(self) -> str | None:
        """The stream with whose samples it is evaluated."""
        stream: str | None = self.spec.get("evaluation", {}).get("onSample")
        return stream

    def episodes(self, subject: Subject, client_timeout: int) -> list[Episode]:
        """All episodes of a subject until now."""
        return episodes(self.history.get(subject, []), *self._times(client_timeout))

    def wakes(self, client_timeout: int) -> set[int]:
        """When one of the times of any subject is over."""
        return {time for history in self.history.values() for time in wakes(history, *self._times(client_timeout))}

    def waking(self, now: int, client_timeout: int) -> set[Subject]:
        """The subjects of which one of the times is over just now."""
        times = self._times(client_timeout)
        return {subject for subject, history in self.history.items() if now in wakes(history, *times)}

    def _times(self, client_timeout: int) -> tuple[int, int, int]:
        hold, cooldown = (nanoseconds(self.spec.get(name, "0s")) for name in ("for", "cooldown"))
        unknown = self.spec.get("unknownTimeout")
        return hold, cooldown, client_timeout if unknown is None else nanoseconds(unknown)


@dataclass(frozen=True)
class Selection:
    """The subjects that a rule is evaluated for: those with one of the clients, and those that wake."""

    clients: set[str]
    subjects: set[Subject]


class Reference:
    """A detector that only defines the semantics."""

    def __init__(
        self,
        rules: dict[str, dict[str, Any]],
        received: Received,
        *,
        lateness: int | None,
        start: int,
        keep_starts: int,
    ) -> None:
        """`rules` are specs by name; `lateness` (ns) with clock Data, None with clock Wall; `keep_starts` in ns."""
        self.received = received
        self.rules = [Rule(name, rules[name]) for name in _in_order(rules)]
        self.lateness = lateness
        self.now = start
        self.newest = -1
        self.ticked = False
        self.waiting: list[Sample] = []
        self.starts: list[Start] = []
        self.reported: list[Reported] = []
        self.keep_starts = keep_starts
        signals = [signal for spec in rules.values() for signal in spec.get("signals", [])]
        over_rules = [
            (of_rule(signal), nanoseconds(signal.get("over", "0s"))) for signal in signals if "ruleName" in signal
        ]
        self._keep = {
            which: max([keep_starts, *(over for named, over in over_rules if named == which)])
            for name in rules
            for which in ((name, False), (name, True))
        }

    def arrive(self, sample: Sample) -> None:
        """Add a sample; with clock Wall the ticks before it have run, but not the one at its time."""
        if self.lateness is None:
            self.advance(sample.time - 1)
        elif self._begins(sample.time):
            self.now = self.received.floor = sample.time - 1
        self.waiting.append(sample)
        self._enter(self.now)
        self._heard(sample.time)

    def nothing(self, time: int) -> None:
        """Add a message without items."""
        if self.lateness is None:
            self.advance(time - 1)
        elif self._begins(time):
            self.now = self.received.floor = time - 1
        self._heard(time)

    def _heard(self, time: int) -> None:
        if self.lateness is not None:
            self.newest = max(self.newest, time)
            self.advance(self.newest - max(self.lateness, 1))

    def finish(self) -> None:
        """End the input: with clock Data, evaluate the samples that have waited for `lateness`."""
        if self.lateness is not None:
            self.advance(self.newest)

    def _begins(self, stamp: int) -> bool:
        """Time begins with the first stamp; until a tick has run, with an earlier one that `lateness` covers."""
        return not self.ticked and (self.newest < 0 or self.newest - (self.lateness or 0) <= stamp <= self.now)

    def _triggers(self) -> set[str]:
        return {rule.on_sample for rule in self.rules if rule.on_sample is not None}

    def _enter(self, until: int) -> None:
        """Move samples into the buffer once their time has come."""
        for each in sorted(self.waiting, key=lambda each: (each.time, each.number)):
            if each.time <= until:
                self.waiting.remove(each)
                self.received.take(each)

    def advance(self, until: int) -> None:
        """Run the ticks up to this time."""
        while (tick := min(self._next_ticks())) <= until:
            self.now, self.ticked = tick, True
            triggers = self._triggers()
            sampled = {(s.stream, s.client) for s in self.waiting if s.time == tick and s.stream in triggers}
            self._enter(tick)
            self._tick(sampled)
        if self.lateness is None:
            self.now = max(self.now, until)

    def _next_ticks(self) -> set[int]:
        """The times at which a rule may be due."""
        regular = {self.now - self.now % period + period for period in self._periods()}
        samples = {each.time for each in self.waiting if each.stream in self._triggers()}
        wakes = {time for rule in self.rules if rule.on_sample for time in rule.wakes(self.received.timeout)}
        return {time for time in regular | samples | wakes if time > self.now}

    def gap(self, time: int) -> None:
        """Continue at this time without the ticks before it."""
        self._enter(time)
        self.now = time
        self.received.gap(time)
        for rule in self.rules:
            for evaluations in rule.evaluations.values():
                evaluations.before.clear()
            for history in rule.history.values():
                history.append(Break(time, lost=False))

    def _periods(self) -> set[int]:
        regular = (rule for rule in self.rules if rule.spec.get("enabled", True) and rule.on_sample is None)
        return {SECOND, *(rule.every for rule in regular)}

    def _tick(self, sampled: set[tuple[str, str]]) -> None:
        """`sampled` has the streams and clients of the samples of this very time."""
        regular = any(self.now % period == 0 for period in self._periods())
        if self.now % SECOND == 0:
            self.received.sweep(self.now)
        if regular:
            lost = self.received.lose(self.now)
            self.starts = [_without(each, lost) for each in self.starts]
            for rule in self.rules:
                for client in lost:
                    rule.looked.pop(client, None)
                for subject, evaluations in rule.evaluations.items():
                    if lost & {*subject[0]}:
                        evaluations.before.clear()
        for rule in self.rules:
            if not rule.spec.get("enabled", True):
                continue
            if rule.on_sample is not None:
                clients = {client for stream, client in sampled if stream == rule.on_sample}
                self._evaluate(rule, Selection(clients, rule.waking(self.now, self.received.timeout)), lose=regular)
            elif self.now % rule.every == 0:
                self._evaluate(rule, None, lose=True)

    def _evaluate(self, rule: Rule, selection: Selection | None, *, lose: bool) -> None:
        timeout = self.received.timeout
        found: dict[Subject, tuple[Observation | Break, dict[str, Any]]] = {}
        if lose:
            for subject in rule.history:
                if any(client not in self.received.known for client in subject[0]):
                    found[subject] = (Break(self.now, lost=True), {})
        if selection is None or selection.clients or selection.subjects:
            for client in self.received.known:
                rule.looked.setdefault(client, []).append(self.now)
            for look in looks(rule.spec, self.received, self.now, lambda client: self._view(rule, client)):
                if (
                    selection is None
                    or look.subject in selection.subjects
                    or selection.clients & {*(look.subject[0] or selection.clients)}
                ):
                    names = (*look.names, *(signal["name"] for signal in rule.derived))
                    seen = replace(look, names=names)
                    if look.near is True or rule.in_progress(look.subject, timeout):
                        evaluations = rule.evaluations.setdefault(look.subject, Evaluations())
                        seen = evaluations.look(rule.derived, seen, self.now, self.keep_starts)
                    found[look.subject] = (self._seen(rule, seen), seen.values)
        reported: list[tuple[Reported, tuple[str, ...]]] = []
        for subject, (seen, known) in found.items():
            before = rule.episodes(subject, timeout)
            rule.history.setdefault(subject, []).append(seen)
            after = rule.episodes(subject, timeout)
            values = known
            if after and subject in rule.evaluations:
                values = known | rule.evaluations[subject].statistics(rule.derived, after[-1].start, self.now)
            if len(after) > len(before):
                reported.append((Reported(rule.name, text(subject), self.now, after[-1].onset, "", values), subject[0]))
            elif after and before and after[-1].end != before[-1].end:
                last = after[-1]
                reported.append(
                    (Reported(rule.name, text(subject), self.now, last.onset, last.reason, values), subject[0])
                )
        for event, clients in sorted(reported, key=lambda each: each[0].subject):
            self.reported.append(event)
            if not event.reason:
                message = {"subject": event.subject, "subjects": list(clients), "values": event.values}
                self.starts.append(Start(rule.name, self.now, clients or None, message))
            else:
                left = tuple(client for client in clients if client in self.received.known)
                message = {"subject": event.subject, "reason": event.reason, "values": event.values}
                self.starts.append(Start(rule.name, self.now, left if clients else None, message, ends=True))

    def _view(self, rule: Rule, client: str) -> dict[str, Any]:
        sources = Sources(self.received, self.starts, self._open(), self._keep)
        streams = [stream for stream in self.received.stale_after if self.received.fresh(client, stream, self.now)]
        view: dict[str, Any] = {"client": client, "labels": {}, "streams": streams}
        for signal in rule.spec.get("signals", []):
            if signal in rule.derived:
                continue
            value = sources.signal(signal, client, self.now, rule.looked[client])
            if value is not NOTHING:
                view[signal["name"]] = value
        return view

    def _open(self) -> dict[str, list[tuple[str, ...] | None]]:
        return {
            rule.name: [
                subject[0] or None
                for subject in rule.history
                if any(each.end is None for each in rule.episodes(subject, self.received.timeout))
            ]
            for rule in self.rules
            if rule.spec.get("enabled", True)
        }

    def _seen(self, rule: Rule, look: SubjectView) -> Observation:
        when = truth(rule.spec["when"], look.variables, look.names)
        until = truth(rule.spec["until"], look.variables, look.names) if "until" in rule.spec else _not(when)
        return Observation(self.now, both(look.in_scope, look.near, when, _not(until)), look.in_scope, until)


def _in_order(rules: dict[str, dict[str, Any]]) -> list[str]:
    """First the rules that depend on none, by name; then those that depend on these; and so on."""
    ordered: list[str] = []
    while len(ordered) < len(rules):
        ordered += sorted(
            name
            for name, spec in rules.items()
            if name not in ordered
            and all(signal.get("ruleName", name) in {*ordered, name} for signal in spec.get("signals", []))
        )
    return ordered


def _without(start: Start, lost: set[str]) -> Start:
    if start.clients is None:
        return start
    left = tuple(client for client in start.clients if client not in lost)
    return Start(start.rule, start.time, left, start.message, start.ends)


def _not(value: Truth) -> Truth:
    return None if value is None else not value
