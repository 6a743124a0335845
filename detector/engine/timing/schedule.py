"""Which rules are evaluated at a tick, and for whom.

A rule with a period is evaluated at its whole multiples, for everybody. A rule with `onSample` is evaluated at the time
of each sample of its stream, for the subjects that the sample's client belongs to; and for single subjects when one of
their times (for, cooldown, unknownTimeout) is over. A rule with `onDemand` is evaluated by `Engine.evaluate_now`.
A paused rule is not evaluated at all. While the machine is too slow, evaluations are left out (see load.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from detector.engine.buffering.clients import Clients
from detector.engine.episodes.subjects import Subject
from detector.engine.timing.load import highest_level, thinning
from detector.engine.timing.ticks import Ticks
from wayside.rules import CompiledRule


@dataclass(frozen=True, slots=True)
class Only:
    """Not everybody, but the subjects that one of the clients belongs to, and these subjects."""

    clients: frozenset[str]
    subjects: frozenset[Subject]

    def takes(self, subject: Subject) -> bool:
        """Whether it is one of them; every client belongs to the fleet."""
        if subject in self.subjects:
            return True
        return any(client in self.clients for client in subject.clients) if subject.clients else bool(self.clients)

    def present(self, clients: Clients) -> list[str]:
        """The clients among which all subjects of one client are, in order of their names."""
        named = {*self.clients, *(client for subject in self.subjects for client in subject.clients)}
        return sorted(client for client in named if client in clients)


class Schedule:
    """Knows the rules' times and wakes, what is paused, and how much is left out."""

    def __init__(self, ticks: Ticks) -> None:
        self._ticks = ticks
        self._wakes: dict[str, dict[Subject, int]] = {}
        """By rule, when single subjects must be looked at; nanoseconds."""
        self._samples: dict[str, int] = {}
        """By rule, how many samples it was due at."""
        self._priorities: frozenset[int] = frozenset()
        self._thinning: Mapping[int, int] = {}
        self.paused: frozenset[str] = frozenset()
        """The names of the rules that are not evaluated for now."""
        self.level = 0
        """How much is left out, from 0 to `highest`."""

    def set_rules(self, rules: Iterable[CompiledRule]) -> None:
        """These rules are evaluated from now on."""
        enabled = {rule.name: rule for rule in rules if rule.enabled}
        self._ticks.set_periods([rule.every_ns for rule in enabled.values() if rule.every_ns is not None])
        self._ticks.set_triggers({rule.on_sample for rule in enabled.values() if rule.on_sample is not None})
        on_sample = {name for name, rule in enabled.items() if rule.on_sample is not None}
        self._wakes = {name: wakes for name, wakes in self._wakes.items() if name in on_sample}
        self._samples = {name: count for name, count in self._samples.items() if name in on_sample}
        self.paused &= enabled.keys()
        self._priorities = frozenset(rule.priority for rule in enabled.values())
        self.set_level(self.level)

    @property
    def highest(self) -> int:
        """The level beyond which nothing more can be left out."""
        return highest_level(self._priorities)

    def set_level(self, level: int) -> None:
        """Thin evaluations by this level from now on; more than `highest` is `highest`."""
        self.level = min(level, self.highest)
        self._thinning = thinning(self.level, self._priorities)

    def thinning(self, rule: CompiledRule) -> int:
        """One in this number of the rule's evaluations takes place."""
        return 1 if rule.on_demand else self._thinning.get(rule.priority, 1)

    def is_thinned(self, rule: CompiledRule, now: int) -> bool:
        """Whether the rule, which is due with its period, is left out this time."""
        if rule.every_ns is None:
            return False
        return now % (rule.every_ns * self.thinning(rule)) != 0

    def whom(self, rule: CompiledRule, now: int, sampled: Mapping[str, frozenset[str]]) -> tuple[Only, bool]:
        """Whom a rule with onSample is evaluated for; and whether samples were left out.

        `sampled` has, by stream, the clients of which samples came just now.
        """
        clients = sampled.get(rule.on_sample or "", frozenset())
        thinned = False
        if clients:
            count = self._samples[rule.name] = self._samples.get(rule.name, -1) + 1
            thinned = count % self.thinning(rule) != 0
        wakes = self._wakes.get(rule.name, {})
        due = frozenset(subject for subject, time in wakes.items() if time <= now)
        for subject in due:  # an evaluation sets the next wake again; a subject that is gone needs none
            del wakes[subject]
        return Only(frozenset() if thinned else clients, due), thinned

    def forget(self, rule: str) -> None:
        """The rule is gone, or means something else now: none of its subjects wakes."""
        self._wakes.pop(rule, None)

    def wake(self, rule: str, subject: Subject, time: int | None) -> None:
        """Evaluate the rule's subject at this time (ns) and at no time that was set before; None: at none."""
        wakes = self._wakes.setdefault(rule, {})
        if time is None:
            wakes.pop(subject, None)
        elif wakes.get(subject) != time:
            wakes[subject] = time
            self._ticks.wake_at(time)
