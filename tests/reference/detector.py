"""The whole of it: arrivals go in, events come out, and at each tick everything is computed anew."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

from tests.reference.aggregates import NOTHING
from tests.reference.episodes import Break, Episode, Seen, Truth, episodes
from tests.reference.signals import Sources, Start, nanoseconds, truth
from tests.reference.world import SECOND, Sample, World

MEMBER = ("client", "labels", "streams")


@dataclass(frozen=True)
class Told:
    """An event. Times are nanoseconds; `reason` is empty where it is a start."""

    rule: str
    subject: str
    time: int
    onset: int
    reason: str
    values: dict[str, Any]


@dataclass
class Rule:
    """A rule as written, and all that was ever seen of its subjects."""

    name: str
    spec: dict[str, Any]
    history: dict[tuple[str, ...], list[Seen | Break]] = field(default_factory=dict)
    looked: dict[str, list[int]] = field(default_factory=dict)
    """The ticks at which a client was looked at since it is known."""

    @property
    def every(self) -> int:
        """Its period."""
        return nanoseconds(self.spec.get("evaluation", {}).get("every", "1s"))

    def episodes(self, subject: tuple[str, ...], client_timeout: int) -> list[Episode]:
        """All episodes of a subject until now."""
        times = [nanoseconds(self.spec.get(name, "0s")) for name in ("for", "cooldown")]
        unknown = self.spec.get("unknownTimeout")
        return episodes(
            self.history.get(subject, []), *times, client_timeout if unknown is None else nanoseconds(unknown)
        )


class Reference:
    """A detector of which only the meaning counts."""

    def __init__(
        self, rules: dict[str, dict[str, Any]], world: World, *, lateness: int | None, start: int, keep_starts: int
    ) -> None:
        """`rules` are specs by name; `lateness` (ns) with clock Data, None with clock Wall; `keep_starts` in ns."""
        self.world = world
        self.rules = [Rule(name, rules[name]) for name in _in_order(rules)]
        self.lateness = lateness
        self.now = start
        self.newest = -1
        self.ticked = False
        self.waiting: list[Sample] = []
        self.starts: list[Start] = []
        self.told: list[Told] = []
        signals = [signal for spec in rules.values() for signal in spec.get("signals", [])]
        self._keep = {
            name: max([keep_starts, *(nanoseconds(s.get("over", "0s")) for s in signals if s.get("rule") == name)])
            for name in rules
        }

    def arrive(self, sample: Sample) -> None:
        """A sample comes; with clock Wall the ticks before it have run by then."""
        if self.lateness is None:
            self.advance(sample.time - 1)
        elif self._begins(sample.time):
            self.now = self.world.floor = sample.time - 1
        self.waiting.append(sample)
        self._enter(self.now)
        if self.lateness is not None:
            self.newest = max(self.newest, sample.time)
            self.advance(self.newest - self.lateness)

    def _begins(self, stamp: int) -> bool:
        """Time begins with the first stamp; until a tick has run, with an earlier one that `lateness` covers."""
        return not self.ticked and (self.newest < 0 or self.newest - (self.lateness or 0) <= stamp <= self.now)

    def _enter(self, until: int) -> None:
        """Nobody sees a sample before its time."""
        for each in sorted(self.waiting, key=lambda each: (each.time, each.number)):
            if each.time <= until:
                self.waiting.remove(each)
                self.world.take(each)

    def advance(self, until: int) -> None:
        """Run the ticks up to here."""
        while (tick := min(self.now - self.now % period + period for period in self._periods())) <= until:
            self.now, self.ticked = tick, True
            self._enter(tick)
            self._tick()
        if self.lateness is None:
            self.now = max(self.now, until)

    def gap(self, time: int) -> None:
        """Time goes on from here without the ticks between."""
        self._enter(time)
        self.now = time
        self.world.gap(time)
        for rule in self.rules:
            for history in rule.history.values():
                history.append(Break(time, lost=False))

    def _periods(self) -> set[int]:
        return {SECOND, *(rule.every for rule in self.rules if rule.spec.get("enabled", True))}

    def _tick(self) -> None:
        lost = self.world.lose(self.now)
        self.starts = [_without(each, lost) for each in self.starts]
        for rule in self.rules:
            for client in lost:
                rule.looked.pop(client, None)
        for rule in self.rules:
            if rule.spec.get("enabled", True) and self.now % rule.every == 0:
                self._evaluate(rule)

    def _evaluate(self, rule: Rule) -> None:
        for client in self.world.known:
            rule.looked.setdefault(client, []).append(self.now)
        views = {client: self._view(rule, client) for client in sorted(self.world.known)}
        found = {subject: (seen, values) for subject, seen, values in self._subjects(rule, views)}
        told: list[Told] = []
        for subject in {*found, *rule.history}:
            is_lost = any(client not in self.world.known for client in subject)
            if subject not in found and not is_lost:
                continue
            timeout = self.world.timeout
            before = rule.episodes(subject, timeout)
            seen, values = (Break(self.now, lost=True), {}) if is_lost else found[subject]
            rule.history.setdefault(subject, []).append(seen)
            after = rule.episodes(subject, timeout)
            if len(after) > len(before):
                told.append(Told(rule.name, "+".join(subject), self.now, after[-1].onset, "", values))
            elif after and before and after[-1].end != before[-1].end:
                told.append(Told(rule.name, "+".join(subject), self.now, after[-1].onset, after[-1].reason, values))
        self.told += sorted(told, key=lambda each: each.subject)
        for each in sorted(told, key=lambda each: each.subject):
            if not each.reason:
                clients = tuple(each.subject.split("+"))
                message = {"subject": each.subject, "subjects": list(clients), "values": each.values}
                self.starts.append(Start(rule.name, self.now, clients, message))

    def _view(self, rule: Rule, client: str) -> dict[str, Any]:
        sources = Sources(self.world, self.starts, self._open(), self._keep)
        streams = [stream for stream in self.world.stale_after if self.world.fresh(client, stream, self.now)]
        view: dict[str, Any] = {"client": client, "labels": {}, "streams": streams}
        for signal in rule.spec.get("signals", []):
            value = sources.signal(signal, client, self.now, rule.looked[client])
            if value is not NOTHING:
                view[signal["name"]] = value
        return view

    def _open(self) -> dict[str, list[tuple[str, ...] | None]]:
        return {
            rule.name: [
                subject
                for subject in rule.history
                if any(each.end is None for each in rule.episodes(subject, self.world.timeout))
            ]
            for rule in self.rules
            if rule.spec.get("enabled", True)
        }

    def _subjects(
        self, rule: Rule, views: dict[str, dict[str, Any]]
    ) -> Iterator[tuple[tuple[str, ...], Seen, dict[str, Any]]]:
        names = [signal["name"] for signal in rule.spec.get("signals", [])]
        scope = rule.spec.get("scope", {"client": {}})
        if "client" in scope:
            for client, view in views.items():
                in_scope = truth(scope["client"].get("where"), view, MEMBER)
                yield (client,), self._seen(rule, view, (*MEMBER, *names), in_scope, near=True), _only(view, names)
            return
        pairs = scope["pairs"]
        places = {client: place for client in views if (place := self._place(pairs["position"], client)) is not None}
        for client, place in places.items():
            views[client]["position"] = dict(zip("xyz", place, strict=True))
        for a, b in combinations(views, 2):
            variables: dict[str, Any] = {"a": views[a], "b": views[b]}
            near: Truth = None
            if a in places and b in places:
                variables["distance"] = math.dist(places[a], places[b])
                near = variables["distance"] <= pairs["within"]
            in_scope = truth(pairs.get("where"), variables, ("a", "b", "distance"))
            seen = self._seen(rule, variables, ("a", "b", "distance"), in_scope, near)
            values = {role: _only(variables[role], ["client", "position", *names]) for role in ("a", "b")}
            yield (a, b), seen, {**_only(variables, ["distance"]), **values}

    def _place(self, position: dict[str, str], client: str) -> tuple[float, float, float] | None:
        mine = self.world.of(client, position["stream"], self.now)
        if not self.world.fresh(client, position["stream"], self.now):
            return None
        message = mine[-1].message
        axes = [message.get(position[axis].removeprefix("msg.")) for axis in ("x", "y")]
        if not all(isinstance(axis, float) and abs(axis) <= 1e12 for axis in axes):
            return None
        return (axes[0], axes[1], 0.0)

    def _seen(
        self, rule: Rule, variables: dict[str, Any], names: tuple[str, ...], in_scope: Truth, near: Truth
    ) -> Seen:
        when = truth(rule.spec["when"], variables, names)
        until = truth(rule.spec["until"], variables, names) if "until" in rule.spec else _not(when)
        return Seen(self.now, _all(in_scope, near, when, _not(until)), in_scope, until)


def _in_order(rules: dict[str, dict[str, Any]]) -> list[str]:
    """First the rules that depend on none, by name; then those that depend on these; and so on."""
    ordered: list[str] = []
    while len(ordered) < len(rules):
        ordered += sorted(
            name
            for name, spec in rules.items()
            if name not in ordered
            and all(signal.get("rule", name) in {*ordered, name} for signal in spec.get("signals", []))
        )
    return ordered


def _without(start: Start, lost: set[str]) -> Start:
    if start.clients is None:
        return start
    left = tuple(client for client in start.clients if client not in lost)
    return Start(start.rule, start.time, left, start.message)


def _only(view: dict[str, Any], names: list[str]) -> dict[str, Any]:
    return {name: view[name] for name in names if name in view}


def _not(value: Truth) -> Truth:
    return None if value is None else not value


def _all(*values: Truth) -> Truth:
    return False if False in values else None if None in values else True
