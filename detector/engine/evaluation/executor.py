"""Carries out the steps of a timeline: inserts samples into the buffer, and evaluates rules at ticks.

Ticks are queued and evaluated together as long as nothing happens between them that an evaluation could see or change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from detector.engine.buffering.buffer import HOUSEKEEPING
from detector.engine.columns.table import LONGEST
from detector.engine.consequences import Consequences
from detector.engine.episodes.events import Event, OrderedEvent
from detector.engine.episodes.subjects import Subject
from detector.engine.evaluation.blocks import Blocks
from detector.engine.evaluation.groups import RuleGroup
from detector.engine.evaluation.inputs import RuleInputs
from detector.engine.evaluation.observing import Observers
from detector.engine.evaluation.pairs import PairGroup
from detector.engine.evaluation.rule import RuleRun
from detector.engine.samples.sample import Arrival
from detector.engine.scoping.plugins import PluginSignals
from detector.engine.signals.starts import EpisodeStarts
from detector.engine.timing.schedule import Schedule, SubjectFilter, Ticks
from detector.engine.timing.steps import Gap, Insert, Step, Tick
from wayside.rules import CompiledRule


class Executor:
    """Inserts samples and evaluates rules, block by block or tick by tick."""

    def __init__(
        self,
        inputs: RuleInputs,
        ticks: Ticks,
        schedule: Schedule,
        starts: EpisodeStarts,
        plugins: PluginSignals,
        consequences: Consequences,
        observers: Observers,
        now: Callable[[], int],
    ) -> None:
        """`now` returns the time up to which all ticks have run; nanoseconds on the engine's time axis."""
        self._inputs = inputs
        self._clients = inputs.clients
        self._ticks = ticks
        self._schedule = schedule
        self._starts = starts
        self._plugins = plugins
        self._consequences = consequences
        self._instruments = observers
        self._now = now
        self._runs: Mapping[str, RuleRun] = {}
        self._blocks = Blocks(inputs.context, lambda: inputs.floor)
        self._order: dict[str, int] = {}
        """The position of each rule in the order of evaluation."""
        self._others: list[CompiledRule] = []
        """Rules that are not evaluated in blocks."""
        self._alone: set[str] = set()
        """Rules with an observer that needs each evaluation separately."""
        self._losing: set[str] = set()
        """Rules whose episodes of lost clients have not been ended yet."""
        self._last_wait = now()
        """The last queued tick."""
        self._unsorted: int | None = None
        """From this index on, the journal is not sorted yet; None: it is sorted."""

    @property
    def in_columns(self) -> frozenset[str]:
        """The rules that are evaluated in columns."""
        return self._blocks.names

    def set_rules(self, runs: Mapping[str, RuleRun]) -> None:
        """Evaluate these rules from now on, in this order."""
        self._runs = runs
        self._losing &= runs.keys()
        self.wake_all(self._now())
        self.plan()

    def follow_detector(self) -> None:
        """The Detector changed; until `set_rules`, rules are evaluated one by one."""
        self._blocks = Blocks(self._inputs.context, lambda: self._inputs.floor)
        self._others = [run.rule for run in self._runs.values() if run.rule.enabled]

    def plan(self) -> None:
        """After a change of rules or thinning: decide which rules are evaluated in columns, and which of them
        together."""
        if self._inputs.tables.full:
            self._inputs.new_tables()
        self._make_blocks()
        if self._inputs.tables.wasteful:
            self._inputs.new_tables()
            self._make_blocks()
        self._order = {name: order for order, name in enumerate(self._runs)}
        names = self._blocks.names
        rules = (run.rule for run in self._runs.values() if run.rule.enabled)
        self._others = [rule for rule in rules if rule.name not in names or rule.every_ns is None]
        self._alone = {name for name, run in self._runs.items() if run.alone}
        for run in self._runs.values():
            run.journal = self._instruments.journal
        self._inputs.update_tables()

    def _make_blocks(self) -> None:
        self._blocks = Blocks(self._inputs.context, lambda: self._inputs.floor, self._instruments.observer)
        thinning = self._schedule.thinning
        self._blocks.set_rules(self._runs, self._schedule.paused, lambda run: thinning(run.rule))

    def run(self, steps: Iterable[Step]) -> list[Event]:
        """Carry out these steps; returns what happened, in order."""
        if {name for name, run in self._runs.items() if run.alone} != self._alone:
            self.plan()
        events: list[Event] = []
        for step in steps:
            match step:
                case Insert(arrivals, times):
                    size = self._inputs.ingest.size_of(arrivals)
                    if self._blocks.waiting and not self._may_wait(arrivals, times, size):
                        events += self._evaluate_waiting()
                    self._inputs.ingest.insert(arrivals, times, size)
                case Tick():
                    events += self._tick(step)
                case Gap(time, backwards):
                    events += self._evaluate_waiting()
                    self.gap(time, backwards)
        events += self._evaluate_waiting()
        if self._inputs.tables.full:
            self.plan()
        self._inputs.end_tick(self._now())
        return events

    def _may_wait(self, arrivals: Sequence[Arrival], times: Sequence[int] | None, size: int) -> bool:
        """Whether these arrivals (at most `size` bytes) change nothing that the queued ticks read."""
        first, last = (arrivals[0].received, arrivals[-1].received) if times is None else (min(times), max(times))
        in_order = times is None or first > self._last_wait
        return in_order and last - self._blocks.since <= LONGEST and self._inputs.buffer.has_room(size)

    def _evaluate_waiting(self) -> list[Event]:
        """Evaluate the queued ticks."""
        if not self._blocks.waiting:
            return []
        self._inputs.update_tables()
        happened = self._in_columns()
        self._inputs.forget_rows(self._last_wait)
        self._inputs.end_tick(self._now())
        self._starts.expire(self._last_wait)
        events = [each.event for each in happened]
        if self._consequences.wanted:
            for event in events:
                self._consequences.note(self._runs[event.episode.rule].rule, event)
        return events

    def _in_columns(self) -> list[OrderedEvent]:
        """Evaluate the queued ticks, and sort what happened."""
        journal = self._instruments.journal
        noted = self._unsorted if self._unsorted is not None else len(journal or ())
        self._unsorted = None
        happened = self._blocks.run(self._instruments.stopwatch)
        if journal is not None:
            order = self._order
            journal[noted:] = sorted(journal[noted:], key=lambda each: (each.time, order[each.demand.episode.rule]))
        return happened

    def _tick(self, tick: Tick) -> list[Event]:
        time, regular = tick.time, self._ticks.is_regular(tick.time)
        events: list[Event] = []
        if self._inputs.tables.full:
            events += self._evaluate_waiting()
            self.plan()
        if regular:  # otherwise it concerns one sample or subject, and must not scan all others
            if self._inputs.clients.may_remove(time):
                events += (
                    self._evaluate_waiting()
                )  # at the queued ticks, the clients that are lost now were still known
                self._expire(time)
            elif time % HOUSEKEEPING == 0:
                self._expire(time)
        self._blocks.skip(time)
        groups = self._blocks.due(time)
        if self._is_alone(tick, groups):
            events += self._evaluate_waiting()
            self._inputs.update_tables()
            return events + self._tick_alone(tick, regular, groups)
        self._last_wait = time
        if self._blocks.wait(time, groups) or self._consequences.wanted:
            events += self._evaluate_waiting()
        elif self._blocks.hurries:
            if self._unsorted is None and self._instruments.journal is not None:
                self._unsorted = len(self._instruments.journal)
            self._inputs.update_tables()
            self._blocks.run_ahead(self._instruments.stopwatch)
            self._inputs.end_tick(self._now())
        return events

    def _is_alone(self, tick: Tick, groups: Sequence[RuleGroup | PairGroup]) -> bool:
        """Whether the tick must be evaluated at once: for rules that are not in columns, or that must check for lost
        clients."""
        if self._losing and any(run.rule.name in self._losing for group in groups for run in group.runs):
            return True
        return any(
            tick.time % rule.every_ns == 0 if rule.every_ns is not None else rule.on_sample or self._losing
            for rule in self._others
        )

    def _tick_alone(self, tick: Tick, regular: bool, groups: Sequence[RuleGroup | PairGroup]) -> list[Event]:
        """Evaluate a tick by itself, rule by rule in their order."""
        time, sampled = tick.time, self._inputs.sampled(tick.sampled)
        due = {run.rule.name for group in groups for run in group.runs}
        happened: dict[str, list[Event]] = {name: self._end_lost(name, time) for name in due}
        self._blocks.wait(time, groups)
        for each in self._in_columns():
            happened[each.event.episode.rule].append(each.event)
        happened |= self._with_samples(time, regular, sampled)
        events: list[Event] = []
        for name, run in self._runs.items():
            if run.rule.enabled and name not in self._schedule.paused:
                own = happened.get(name)
                if own is None and name not in self._blocks.names:
                    self._losing.discard(name)
                    own = self._made_visible(self._evaluate_rule(run, time, sampled, regular))
                if own:
                    own.sort(key=lambda event: event.episode.subject)
                    events += own
                    for event in own:
                        self._consequences.note(run.rule, event)
        self._starts.expire(time)
        self._inputs.forget_rows(time)
        self._inputs.end_tick(self._now())
        return events

    def _end_lost(self, name: str, time: int) -> list[Event]:
        """End a rule's episodes whose clients are lost."""
        if name not in self._losing:
            return []
        self._losing.discard(name)
        return self._made_visible(self._runs[name].end_lost(time, self._clients))

    def _with_samples(
        self, time: int, regular: bool, sampled: Mapping[str, frozenset[str]]
    ) -> Mapping[str, list[Event]]:
        """Evaluate the rules in columns that samples trigger; returns what happened, by rule."""
        happened: dict[str, list[Event]] = {}
        for stream, runs in self._blocks.with_samples.items():
            chosen: dict[str, SubjectFilter] = {}
            named: set[str] = set()
            for run in runs:
                name = run.rule.name
                happened[name] = self._end_lost(name, time) if regular else []
                only, thinned = self._schedule.selection(run.rule, time, sampled)
                run.counters.skipped += thinned
                if only.clients or only.subjects:
                    chosen[name] = only
                    named |= only.named
            if chosen:
                clients = sorted([client for client in named if client in self._clients])
                for each in self._blocks.run_with_samples(stream, time, clients, chosen, self._instruments.stopwatch):
                    happened[each.event.episode.rule].append(each.event)
                for name, only in chosen.items():
                    # The others have no wake that is due, and none of their timers has changed.
                    due = [subject for subject in only.subjects if subject.clients[0] in self._clients]
                    self._wake(self._runs[name], time, (*self._runs[name].touched, *due))
        return happened

    def _made_visible(self, events: list[Event]) -> list[Event]:
        """Return the events, after making them visible to rules that read episodes of other rules."""
        for event in events:
            self._starts.note(event)
        return events

    def noted(self, run: RuleRun, events: Iterable[Event]) -> list[Event]:
        """Return the events, after reporting them to other rules and to the rule's actions."""
        happened = self._made_visible([*events])
        for event in happened:
            self._consequences.note(run.rule, event)
        return happened

    def _evaluate_rule(
        self, run: RuleRun, time: int, sampled: Mapping[str, frozenset[str]], regular: bool
    ) -> list[Event]:
        """Evaluate a rule if it is due; `regular`: the tick belongs to a rule's period or to housekeeping."""
        rule = run.rule
        if rule.every_ns is not None:
            if time % rule.every_ns:
                return []
            if self._schedule.is_thinned(rule, time):
                run.counters.skipped += 1
                return []
            return self._evaluated(run, time)
        events = run.end_lost(time, self._clients) if regular else []
        if rule.on_sample is None:
            return events
        only, thinned = self._schedule.selection(rule, time, sampled)
        run.counters.skipped += thinned
        if only.clients or only.subjects:
            events += self._evaluated(run, time, only)
            self._wake(run, time, run.touched)
        return sorted(events, key=lambda event: event.episode.subject)

    def _evaluated(self, run: RuleRun, time: int, only: SubjectFilter | None = None) -> list[Event]:
        begin = self._instruments.stopwatch()
        events = run.tick(time, self._inputs.views(run, time), self._clients, self._plugins, only)
        run.counters.timed(time, self._instruments.stopwatch() - begin)
        return events

    def _expire(self, time: int) -> None:
        """Drop expired samples and lost clients."""
        lost = self._inputs.expire(time)
        if lost:
            self._losing.update(self._runs)
            self._starts.forget_clients(lost)
            self._plugins.forget_clients(lost)
            for run in self._runs.values():
                run.earlier.forget_clients(lost)

    def _wake(self, run: RuleRun, time: int, subjects: Iterable[Subject]) -> None:
        for subject, at in run.wakes(time, subjects):
            self._schedule.wake(run.rule.name, subject, at)

    def wake_all(self, time: int) -> None:
        """Rules or time changed: evaluate every subject at the next tick."""
        for run in self._runs.values():
            if run.rule.on_sample is not None:
                self._wake(run, time, run.states)

    def gap(self, time: int, backwards: bool) -> None:
        """Continue at this time without the ticks between; `backwards`: it may be earlier. Nanoseconds."""
        if backwards:
            self._starts.step_back(time)
        self._inputs.gap(time, backwards)
        self._plugins.gap()
        for run in self._runs.values():
            run.gap(time)
        self.wake_all(time)
