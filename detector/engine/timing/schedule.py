"""Which rules are evaluated at a tick, and for which subjects.

A rule with a period is evaluated at its whole multiples, for all subjects. A rule with `onSample` is evaluated at the
time of each sample of its stream, for the subjects that the sample's client belongs to; and for single subjects when
one of their timers (for, cooldown, unknownTimeout) expires. A rule with `onDemand` is evaluated by
`Engine.evaluate_now`. A paused rule is not evaluated at all.

While the machine is too slow, evaluations are skipped, by a level that the caller gives. Each class of rules with the
same priority, from the lowest, is thinned in three steps: every second evaluation, every fourth, every eighth. The next
class is thinned once the class below it has reached its last step. At level 0 no evaluation is skipped.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from detector.engine.buffering.buffer import HOUSEKEEPING
from detector.engine.buffering.clients import Clients
from detector.engine.episodes.subjects import Subject
from wayside.rules import CompiledRule


class Ticks:
    """Times of ticks apart from samples: whole multiples of the rules' periods, and the wakes of subjects."""

    def __init__(self) -> None:
        self._periods: tuple[int, ...] = (HOUSEKEEPING,)
        self._wakes: list[int] = []
        """A heap; past entries are removed when they reach the top."""
        self.triggers: frozenset[str] = frozenset()
        """The streams whose samples are evaluated at their own times."""

    def set_periods(self, periods: Collection[int]) -> None:
        """The rules' periods, in nanoseconds."""
        self._periods = tuple(sorted({HOUSEKEEPING, *periods}))

    def set_triggers(self, streams: Collection[str]) -> None:
        """The streams whose samples are evaluated at their own times."""
        self.triggers = frozenset(streams)

    def wake_at(self, time: int) -> None:
        """Schedule a tick at this time, if it is still in the future."""
        heapq.heappush(self._wakes, time)

    def after(self, time: int) -> int:
        """The first tick after a time."""
        regular = min(time - time % period + period for period in self._periods)
        while self._wakes and self._wakes[0] <= time:
            heapq.heappop(self._wakes)
        return min(regular, self._wakes[0]) if self._wakes else regular

    def is_regular(self, time: int) -> bool:
        """Whether the tick belongs to a period, not only to a sample or a wake."""
        return any(time % period == 0 for period in self._periods)


STEPS = (1, 2, 4, 8)
"""By level: one in this number of evaluations takes place."""


def highest_level(priorities: Collection[int]) -> int:
    """The level at which thinning reaches its maximum."""
    return len(set(priorities)) * (len(STEPS) - 1)


def thinning(level: int, priorities: Collection[int]) -> Mapping[int, int]:
    """By priority of the rules: one in this number of evaluations takes place."""
    found = {}
    for priority in sorted(set(priorities)):
        step = min(level, len(STEPS) - 1)
        found[priority] = STEPS[step]
        level -= step
    return found


class SubjectFilter(NamedTuple):
    """A selection of subjects: those that one of the clients belongs to, and these subjects."""

    clients: frozenset[str]
    subjects: frozenset[Subject]

    def contains(self, subject: Subject) -> bool:
        """Whether it contains the subject; every client belongs to the fleet."""
        if subject in self.subjects:
            return True
        return any(client in self.clients for client in subject.clients) if subject.clients else bool(self.clients)

    def present(self, clients: Clients) -> list[str]:
        """The known clients of the selection, sorted by name."""
        return sorted([client for client in self.named if client in clients])

    @property
    def named(self) -> frozenset[str]:
        """The selected clients, and the clients of the selected subjects."""
        return self.clients.union(*(subject.clients for subject in self.subjects)) if self.subjects else self.clients


_NOBODY: frozenset[str] = frozenset()


class Schedule:
    """Tracks the rules' periods and wakes, pauses, and thinning."""

    def __init__(self, ticks: Ticks) -> None:
        self._ticks = ticks
        self._wakes: dict[str, dict[Subject, int]] = {}
        """By rule, when single subjects must be evaluated; nanoseconds."""
        self._samples: dict[str, int] = {}
        """By rule, the number of samples that triggered it."""
        self._priorities: frozenset[int] = frozenset()
        self._thinning: Mapping[int, int] = {}
        self._only = SubjectFilter(_NOBODY, frozenset())
        """The last selection without single subjects, cached: most rules share it."""
        self.paused: frozenset[str] = frozenset()
        """The names of paused rules."""
        self.level = 0
        """The level of thinning, from 0 to `highest`."""

    def set_rules(self, rules: Iterable[CompiledRule]) -> None:
        """Evaluate these rules from now on."""
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
        """The level at which thinning reaches its maximum."""
        return highest_level(self._priorities)

    def set_level(self, level: int) -> None:
        """Set the level of thinning; values above `highest` mean `highest`."""
        self.level = min(level, self.highest)
        self._thinning = thinning(self.level, self._priorities)

    def thinning(self, rule: CompiledRule) -> int:
        """One in this number of the rule's evaluations takes place."""
        return 1 if rule.on_demand else self._thinning.get(rule.priority, 1)

    def is_thinned(self, rule: CompiledRule, now: int) -> bool:
        """Whether this evaluation of the rule, due by its period, is skipped."""
        if rule.every_ns is None:
            return False
        return now % (rule.every_ns * self.thinning(rule)) != 0

    def selection(
        self, rule: CompiledRule, now: int, sampled: Mapping[str, frozenset[str]]
    ) -> tuple[SubjectFilter, bool]:
        """The subjects for which a rule with onSample is evaluated, and whether samples were skipped.

        `sampled` has, by stream, the clients with samples at this time.
        """
        clients = sampled.get(rule.on_sample or "", _NOBODY)
        thinned = False
        if clients:
            count = self._samples[rule.name] = self._samples.get(rule.name, -1) + 1
            thinned = self.level > 0 and count % self.thinning(rule) != 0
        wakes = self._wakes.get(rule.name)
        if not wakes and not thinned:
            if clients is not self._only.clients:
                self._only = SubjectFilter(clients, frozenset())
            return self._only, False
        due = frozenset(subject for subject, time in wakes.items() if time <= now) if wakes else frozenset()
        for subject in due:  # an evaluation sets the next wake; a subject that no longer exists needs none
            del self._wakes[rule.name][subject]
        return SubjectFilter(_NOBODY if thinned else clients, due), thinned

    def forget(self, rule: str) -> None:
        """The rule was removed or has changed its meaning: remove the wakes of its subjects."""
        self._wakes.pop(rule, None)

    def wake(self, rule: str, subject: Subject, time: int | None) -> None:
        """Evaluate the rule's subject at this time (ns), and cancel earlier requests; None: only cancel."""
        wakes = self._wakes.setdefault(rule, {})
        if time is None:
            wakes.pop(subject, None)
        elif wakes.get(subject) != time:
            wakes[subject] = time
            self._ticks.wake_at(time)


LONG = 250_000_000
"""Maximum nanoseconds for the evaluation of one cycle; from 1 s on, ticks are lost."""

CALM = 10 * 10**9
"""Nanoseconds without a slow cycle after which the level falls by one."""


class Overload:
    """The level of thinning, from the duration of the evaluator's cycles.

    A slow cycle means that ticks are overdue: the level rises by one at once. It falls by one after each ten seconds
    without a slow cycle.
    """

    def __init__(self) -> None:
        self.level = 0
        self._since = 0
        """The time of the last slow cycle or of the last decrease of the level; nanoseconds."""

    def observe(self, now: int, spent: int, highest: int) -> bool:
        """Called at the end of a cycle that took `spent` nanoseconds; returns whether the level changed.

        `highest`: the level at which thinning reaches its maximum.
        """
        before = self.level = min(self.level, highest)
        if spent > LONG:
            self._since = now
            self.level = min(self.level + 1, highest)
        elif self.level and now - self._since >= CALM:
            self._since = now
            self.level -= 1
        return self.level != before
