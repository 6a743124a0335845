"""The engine: arrivals and the time go in, events come out, and the demands of what is open can be asked for.

It reads no clock and does no I/O. Live operation, the replay of a recording and the tests call the same methods
(`advance`, `gap`, `set_rules`, `restore`, `finish`), always from one thread; the same calls give the same events, ids
included.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

from detector.engine.blocks import Blocks, RuleGroup
from detector.engine.buffering.messages import KeyReader
from detector.engine.columns.table import LONGEST
from detector.engine.consequences.consequences import Consequences
from detector.engine.counters import Counters
from detector.engine.episodes.current import Identity
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.episodes import Reason
from detector.engine.episodes.events import Event
from detector.engine.episodes.open_episodes import OpenEpisode, ended_while_away, episode_of
from detector.engine.episodes.subjects import Subject
from detector.engine.evaluation import Answer, Change, RuleRun, same_semantics
from detector.engine.happened import Happened
from detector.engine.knowledge import Knowledge
from detector.engine.observing import Observer
from detector.engine.pairs import PairGroup
from detector.engine.queries.queries import BufferQueries
from detector.engine.samples.sample import Arrival, Decoder, Sample
from detector.engine.scoping.plugins import NoPlugins, PluginHost, PluginSignals
from detector.engine.signals.starts import Starts
from detector.engine.timing.data import DataTimeline
from detector.engine.timing.schedule import Only, Schedule
from detector.engine.timing.steps import Gap, Insert, Step, Tick
from detector.engine.timing.ticks import HOUSEKEEPING, Ticks
from detector.engine.timing.timeline import ORDER, Timeline
from detector.engine.timing.wall import WallTimeline
from wayside.api import Detector
from wayside.api.detector import Clock
from wayside.rules import CompiledRule, in_order

__all__ = ["Engine", "KeyReader"]


class NoAnswerError(ValueError):
    """A rule was asked that cannot answer; the text says why, and what to do."""


class Engine:
    """Buffers samples, evaluates rules at their ticks and keeps the episodes."""

    def __init__(
        self,
        detector: Detector,
        *,
        holder: str,
        decoders: Mapping[str, Decoder],
        read_key: KeyReader,
        start: int,
        plugins: PluginHost | None = None,
        order: int = ORDER,
    ) -> None:
        """`start` is when the detector started, in nanoseconds since the epoch; `decoders` has one for each stream.

        `plugins` runs them; without it, their signals are unknown. `order`: see `timeline.ORDER`.

        Raises:
            RuleError: an expression of one of the Detector's streams does not compile.
        """
        self.identity = Identity(detector.name, holder, detector.namespace)
        self.counters = Counters()
        self._runs: dict[str, RuleRun] = {}
        self._rules_version = 0
        self._exact = order >= ORDER
        self._ticks = Ticks()
        self.schedule = Schedule(self._ticks)
        self._starts = Starts()
        self._known = Knowledge(detector, decoders, read_key, start, self.counters, self._starts, exact=self._exact)
        self.buffer, self.clients = self._known.buffer, self._known.clients
        self.stopwatch: Callable[[], int] = int
        """Gives nanoseconds of any clock; the shell sets one that runs. What it says is counted and decides nothing."""
        self._plugins = PluginSignals(plugins or NoPlugins(), self.queries)
        self.consequences = Consequences(self.buffer)
        """What the actions other than deploy are told."""
        self._timeline = self._make_timeline(start)
        self._blocks = Blocks(self._known.context, lambda: self._known.floor)
        self._order: dict[str, int] = {}
        """The rules' places in the order of evaluation."""
        self._others: list[CompiledRule] = []
        """Rules that are not evaluated in blocks."""
        self._alone: set[str] = set()
        """Rules of which somebody looks at each evaluation by itself."""
        self._losing: set[str] = set()
        """Rules that have not looked yet who was lost."""
        self._last_wait = start
        """The last tick that waits to be evaluated."""
        self._unsorted: int | None = None
        """From where on the journal is not in order yet; None: it is."""
        self.journal: list[Change] | None = None
        """What became of demands, in order; None while nobody wants to know."""
        self.observer: Observer | None = None
        """Looks on at what is evaluated in columns; it is set before the rules are."""

    def set_detector(self, detector: Detector, decoders: Mapping[str, Decoder], read_key: KeyReader) -> None:
        """Go on with a changed Detector; call `set_rules` afterwards, with the rules compiled against it.

        Samples of streams that are read as before stay, and so do open episodes. A change of the clock begins a new
        time axis: the buffer is emptied, what was pending is forgotten.

        Raises:
            RuleError: an expression of one of the Detector's streams does not compile; nothing has changed then.
        """
        before = self.detector.spec
        self._known.follow(detector, decoders, read_key, self._timeline.now)
        self._blocks = Blocks(self._known.context, lambda: self._known.floor)
        self._others = [run.rule for run in self._runs.values() if run.rule.enabled]
        if isinstance(self._timeline, DataTimeline):
            self._timeline.max_behind = _longest(detector)
            self._timeline.latched = _latched(detector)
            self._timeline.alone_after = detector.spec.client_timeout.ns
            self._timeline.maximum_bytes = detector.spec.buffer.bytes.bytes
        times = (detector.spec.clock, detector.spec.lateness, detector.spec.max_ahead)
        if times != (before.clock, before.lateness, before.max_ahead):
            self._run(self._timeline.rest())
            now = self._timeline.now
            self._timeline = self._make_timeline(now)
            self._gap(now, backwards=detector.spec.clock is not before.clock)

    @property
    def detector(self) -> Detector:
        """As it is followed now."""
        return self._known.detector

    def advance(self, arrivals: Sequence[Arrival], until: int) -> list[Event]:
        """Take in what arrived, in order, and run the ticks up to `until`, or to the last arrival if that is later.

        Arrivals of equal time come in one call: what comes in a later one is later than all of these and than `until`.
        """
        return self._run(self._timeline.steps(arrivals, until))

    def finish(self) -> Iterator[list[Event]]:
        """Nothing more comes: what still has to be evaluated, step by step. With clock Wall nothing has.

        The demands that are open between two steps can be asked for there.
        """
        for step in self._timeline.finish():
            yield self._run((step,))

    def gap(self, time: int) -> list[Event]:
        """The wall clock stood still or jumped: go on from `time`; windows reset, open episodes hold."""
        return self._run(self._timeline.gap(time))

    def set_rules(self, rules: Sequence[CompiledRule]) -> list[Event]:
        """Evaluate these rules from now on. Episodes of rules that are gone or mean something else end."""
        now = self._timeline.now
        new = {rule.name: rule for rule in rules}
        events: list[Event] = []
        runs: dict[str, RuleRun] = {}
        kept: set[str] = set()
        for name, run in sorted(self._runs.items()):
            rule = new.get(name)
            if rule is None or not same_semantics(run, rule):
                events += self._noted(run, run.end_all(now, Reason.RULE_CHANGED))
                self._starts.forget(name)
                self.schedule.forget(name)
            else:
                before = run.rule
                run.change_actions(rule)
                self.consequences.change(before, rule, run.open_starts())
                runs[name] = run
                kept.add(name)
        for name, rule in new.items():
            if name not in runs:
                runs[name] = RuleRun(rule, self.identity, self.counters.rule(name))
        self._runs = {rule.name: runs[rule.name] for rule in in_order([run.rule for run in runs.values()])}
        for name in sorted(self._starts.configure(rules, self.detector.spec.buffer.duration.ns)):
            for event in runs[name].open_starts() if name in runs else ():
                self._starts.started(event)
        self._known.forget_rules(kept)
        self._plugins.configure(rules, kept)
        self.schedule.set_rules([run.rule for run in self._runs.values()])
        self._wake_anew(now)
        self._rules_version += 1
        self._plan()
        return events

    def restore(self, demands: Sequence[Demand], now: int, episodes: Sequence[OpenEpisode] = ()) -> list[Event]:
        """Take up the episodes that were open before a restart; those whose rule changed meanwhile end.

        First those of the demands, then of `episodes` those that had none.
        """
        demanded: dict[tuple[str, str, str], list[Demand]] = {}
        for demand in demands:
            demanded.setdefault((demand.rule, demand.subject, demand.episode), []).append(demand)
        events: list[Event] = []
        for _, of_one in sorted(demanded.items()):
            episode = episode_of(of_one[0])
            whole = episode.subject.text == of_one[0].subject
            events += self._take_up(episode, of_one, now) if whole else [self._ended_while_away(episode, now)]
        known = {demand.episode for demand in demands}
        for episode in sorted(episodes, key=lambda each: (each.rule, each.subject.text, each.episode)):
            if episode.episode not in known:
                events += self._take_up(episode, (), now)
        self._rules_version += 1
        return events

    def _take_up(self, episode: OpenEpisode, demands: Sequence[Demand], now: int) -> list[Event]:
        run = self._runs.get(episode.rule)
        if run is None or not run.can_restore(episode):
            return [self._ended_while_away(episode, now)]
        event = run.restore(episode, demands)
        self._starts.started(event)
        self.consequences.begin(run.rule.actions, run.rule, event, resumed=True)
        for client in episode.subject.clients:
            self.clients.heard(client, now)
        return []

    def _ended_while_away(self, episode: OpenEpisode, now: int) -> Event:
        return ended_while_away(episode, self.identity.holder, now)

    def open_episodes(self) -> list[OpenEpisode]:
        """All episodes that have not ended."""
        return [episode for run in self._runs.values() for episode in run.episodes()]

    def set_paused(self, names: Collection[str]) -> None:
        """Do not evaluate these rules until further notice, and all others again; names of no rule mean nothing.

        Open episodes of a paused rule hold, what was pending is forgotten.
        """
        for name in self._runs.keys() & names:
            self._runs[name].forget_pending()
        self.schedule.paused = frozenset(self._runs.keys() & names)
        self._plan()
        self._wake_anew(self.now)

    def set_level(self, level: int) -> None:
        """Thin evaluations by this level from now on (see load.py); 0: none."""
        self.schedule.set_level(level)
        self._plan()

    def ask(self, name: str) -> tuple[list[Event], list[Answer]]:
        """Evaluate a rule with `onDemand` now: after the last tick, with what was taken in since up to `now`.

        Returns what started and ended, and what the rule says of each subject.

        Raises:
            NoAnswerError: there is no such rule, or it is none that is evaluated on demand, disabled or paused.
        """
        run = self._runs.get(name)
        if run is None:
            raise NoAnswerError(f"there is no rule {name}; there is {', '.join(sorted(self._runs)) or 'none'}")
        if not run.rule.on_demand:
            raise NoAnswerError(f"rule {name} is not evaluated on demand: write evaluation: {{onDemand: true}}")
        if not run.rule.enabled or name in self.schedule.paused:
            raise NoAnswerError(f"rule {name} is {'paused: resume it' if run.rule.enabled else 'not enabled'}")
        events, answers = run.answer(self.now, self._known.views(run, self.now), self.clients, self._plugins)
        self._noted(run, events)
        self._known.looked(self.now)
        return events, answers

    def demands(self) -> dict[str, Demand]:
        """What the open episodes ask for, by the names of the tasks."""
        return {demand.name: demand for run in self._runs.values() for demand in run.demands()}

    @property
    def demands_version(self) -> tuple[int, int]:
        """Changes whenever the demands do, so that they need be asked for only then."""
        return self._rules_version, sum(run.version for run in self._runs.values())

    def next_tick(self) -> int:
        """When the next tick is due, with clock Wall; nanoseconds since the epoch."""
        return self._ticks.after(self._timeline.now)

    @property
    def triggers(self) -> frozenset[str]:
        """The streams whose samples make rules be evaluated."""
        return self._ticks.triggers

    @property
    def now(self) -> int:
        """Up to here all ticks have run; nanoseconds on the engine's time axis."""
        return self._timeline.now

    @property
    def on_wall_clock(self) -> bool:
        """Whether the shell says how far time has come; else the samples do."""
        return isinstance(self._timeline, WallTimeline)

    @property
    def timeline(self) -> Timeline:
        """The time axis; with clock Data it counts what it dropped."""
        return self._timeline

    def latency(self, sample: Sample, stream: str) -> float | None:
        """Seconds from the sample's stamp to its receipt; None where it carries no stamp. Counts nothing."""
        return self._known.latency(sample, stream)

    @property
    def in_columns(self) -> frozenset[str]:
        """The rules that are evaluated in columns, and so are seen by the observer."""
        return self._blocks.names

    @property
    def rules(self) -> Mapping[str, RuleRun]:
        """The rules that are evaluated, by name."""
        return self._runs

    def queries(self) -> BufferQueries:
        """What is in the buffer now."""
        return self._known.queries(self.now)

    def _plan(self) -> None:
        """Decide which rules are evaluated in columns, and which together, after rules or thinning changed."""
        if self._known.tables.full:
            self._known.new_tables()
        self._make_blocks()
        if self._known.tables.wasteful:
            self._known.new_tables()
            self._make_blocks()
        self._order = {name: order for order, name in enumerate(self._runs)}
        names = self._blocks.names
        rules = (run.rule for run in self._runs.values() if run.rule.enabled)
        self._others = [rule for rule in rules if rule.name not in names or rule.every_ns is None]
        self._alone = {name for name, run in self._runs.items() if run.alone}
        for run in self._runs.values():
            run.journal = self.journal
        self._known.settle()

    def _make_blocks(self) -> None:
        self._blocks = Blocks(self._known.context, lambda: self._known.floor, self.observer)
        thinning = self.schedule.thinning
        self._blocks.set_rules(self._runs, self.schedule.paused, lambda run: thinning(run.rule))

    def _run(self, steps: Iterable[Step]) -> list[Event]:
        if {name for name, run in self._runs.items() if run.alone} != self._alone:
            self._plan()
        events: list[Event] = []
        for step in steps:
            match step:
                case Insert(arrivals, times):
                    if self._blocks.waiting and not self._may_wait(arrivals, times):
                        events += self._evaluate_waiting()
                    self._known.inflow.insert(arrivals, times)
                case Tick():
                    events += self._tick(step)
                case Gap(time, backwards):
                    events += self._evaluate_waiting()
                    self._gap(time, backwards)
        events += self._evaluate_waiting()
        if self._known.tables.full:
            self._plan()
        self._known.looked(self.now)
        return events

    def _may_wait(self, arrivals: Sequence[Arrival], times: Sequence[int] | None) -> bool:
        """Whether what comes changes nothing that the ticks that wait see."""
        first, last = (arrivals[0].received, arrivals[-1].received) if times is None else (min(times), max(times))
        in_order = times is None or first > self._last_wait
        return in_order and last - self._blocks.since <= LONGEST and self._known.fits(arrivals)

    def _evaluate_waiting(self) -> list[Event]:
        """Evaluate the ticks that wait."""
        if not self._blocks.waiting:
            return []
        self._known.settle()
        happened = self._in_columns()
        self._known.forget_rows(self._last_wait)
        self._known.looked(self.now)
        self._starts.settle(self._last_wait)
        events = [each.event for each in happened]
        if self.consequences.wanted:
            for event in events:
                self.consequences.note(self._runs[event.rule].rule, event)
        return events

    def _in_columns(self) -> list[Happened]:
        """Evaluate what waits, and put in order what happened."""
        noted = self._unsorted if self._unsorted is not None else 0 if self.journal is None else len(self.journal)
        self._unsorted = None
        happened = self._blocks.run(self.stopwatch)
        if self.journal is not None:
            self.journal[noted:] = sorted(
                self.journal[noted:], key=lambda change: (change.time, self._order[change.demand.rule])
            )
        return happened

    def _tick(self, tick: Tick) -> list[Event]:
        time, regular = tick.time, self._ticks.is_regular(tick.time)
        events: list[Event] = []
        if self._known.tables.full:
            events += self._evaluate_waiting()
            self._plan()
        if regular:  # else it is there for a single sample or subject, and must cost no look at all the others
            if self._known.clients.may_lose(time):
                events += self._evaluate_waiting()  # who is lost now was known at the ticks before
                self._keep_house(time)
            elif time % HOUSEKEEPING == 0:
                self._keep_house(time)
        self._blocks.skip(time)
        groups = self._blocks.due(time)
        if self._is_alone(tick, groups):
            events += self._evaluate_waiting()
            self._known.settle()
            return events + self._tick_alone(tick, regular, groups)
        self._last_wait = time
        if self._blocks.wait(time, groups) or self.consequences.wanted:
            events += self._evaluate_waiting()
        elif self._blocks.hurries:
            if self._unsorted is None and self.journal is not None:
                self._unsorted = len(self.journal)
            self._known.settle()
            self._blocks.run_ahead(self.stopwatch)
            self._known.looked(self.now)
        return events

    def _is_alone(self, tick: Tick, groups: Sequence[RuleGroup | PairGroup]) -> bool:
        """Whether the tick cannot wait: for rules that are not in columns, or have to look who was lost."""
        if self._losing and any(run.rule.name in self._losing for group in groups for run in group.runs):
            return True
        return any(
            tick.time % rule.every_ns == 0 if rule.every_ns is not None else rule.on_sample or self._losing
            for rule in self._others
        )

    def _tick_alone(self, tick: Tick, regular: bool, groups: Sequence[RuleGroup | PairGroup]) -> list[Event]:
        """Evaluate a tick by itself, rule by rule in their order."""
        time, sampled = tick.time, self._known.sampled(tick.sampled)
        due = {run.rule.name for group in groups for run in group.runs}
        happened: dict[str, list[Event]] = {name: self._lost(name, time) for name in due}
        self._blocks.wait(time, groups)
        for each in self._in_columns():
            happened[each.event.rule].append(each.event)
        happened |= self._with_samples(time, regular, sampled)
        events: list[Event] = []
        for name, run in self._runs.items():
            if run.rule.enabled and name not in self.schedule.paused:
                own = happened.get(name)
                if own is None and name not in self._blocks.names:
                    self._losing.discard(name)
                    own = self._seen(self._turn(run, time, sampled, regular))
                for event in sorted(own or (), key=lambda event: event.subject):
                    self.consequences.note(run.rule, event)
                    events.append(event)
        self._starts.settle(time)
        self._known.forget_rows(time)
        self._known.looked(self.now)
        return events

    def _lost(self, name: str, time: int) -> list[Event]:
        """The ends of a rule's episodes whose clients are lost."""
        if name not in self._losing:
            return []
        self._losing.discard(name)
        return self._seen(self._runs[name].lose(time, self.clients))

    def _with_samples(
        self, time: int, regular: bool, sampled: Mapping[str, frozenset[str]]
    ) -> Mapping[str, list[Event]]:
        """What happens to the rules in columns that are evaluated with samples, by rule."""
        happened: dict[str, list[Event]] = {}
        for stream, runs in self._blocks.with_samples.items():
            chosen: dict[str, Only] = {}
            for run in runs:
                name = run.rule.name
                happened[name] = self._lost(name, time) if regular else []
                only, thinned = self.schedule.whom(run.rule, time, sampled)
                run.counters.skipped += thinned
                if only.clients or only.subjects:
                    chosen[name] = only
            if chosen:
                for each in self._blocks.run_with_samples(stream, time, chosen, self.stopwatch):
                    happened[each.event.rule].append(each.event)
                for name, only in chosen.items():
                    self._wake(self._runs[name], time, self._looked_at(self._runs[name], only))
        return happened

    def _looked_at(self, run: RuleRun, only: Only) -> list[Subject]:
        """The subjects of a rule about clients that were evaluated."""
        subjects = (
            Subject((client,), element.name) for element in run.rule.elements for client in only.present(self.clients)
        )
        return [subject for subject in subjects if only.takes(subject)]

    def _seen(self, events: list[Event]) -> list[Event]:
        """The events, once rules that look at episodes of others can see them."""
        for event in events:
            self._starts.note(event)
        return events

    def _noted(self, run: RuleRun, events: Iterable[Event]) -> list[Event]:
        """The events, once other rules and the rule's actions know of them."""
        happened = self._seen([*events])
        for event in happened:
            self.consequences.note(run.rule, event)
        return happened

    def _turn(self, run: RuleRun, time: int, sampled: Mapping[str, frozenset[str]], regular: bool) -> list[Event]:
        """What happens to a rule at a tick; `regular`: it is one of some rule's periods, or of housekeeping."""
        rule = run.rule
        if rule.every_ns is not None:
            if time % rule.every_ns:
                return []
            if self.schedule.is_thinned(rule, time):
                run.counters.skipped += 1
                return []
            return self._evaluated(run, time)
        events = run.lose(time, self.clients) if regular else []
        if rule.on_sample is None:
            return events
        only, thinned = self.schedule.whom(rule, time, sampled)
        run.counters.skipped += thinned
        if only.clients or only.subjects:
            events += self._evaluated(run, time, only)
            self._wake(run, time, run.looked_at)
        return sorted(events, key=lambda event: event.subject)

    def _evaluated(self, run: RuleRun, time: int, only: Only | None = None) -> list[Event]:
        begin = self.stopwatch()
        events = run.tick(time, self._known.views(run, time), self.clients, self._plugins, only)
        run.counters.timed(time, self.stopwatch() - begin)
        return events

    def _keep_house(self, time: int) -> None:
        """Forget old samples and lost clients."""
        lost = self._known.age(time)
        if lost:
            self._losing.update(self._runs)
            self._starts.lose(lost)
            self._plugins.lose(lost)

    def _wake(self, run: RuleRun, time: int, subjects: Iterable[Subject]) -> None:
        for subject, at in run.wakes(time, subjects):
            self.schedule.wake(run.rule.name, subject, at)

    def _wake_anew(self, time: int) -> None:
        """Rules or time changed."""
        for run in self._runs.values():
            if run.rule.on_sample is not None:
                self._wake(run, time, run.subjects)

    def _gap(self, time: int, backwards: bool) -> None:
        if backwards:
            self._starts.step_back(time)
        self._known.gap(time, backwards)
        self._plugins.gap()
        for run in self._runs.values():
            run.gap(time)
        self._wake_anew(time)

    def _make_timeline(self, start: int) -> Timeline:
        spec = self.detector.spec
        self.consequences.watch_late = spec.clock is Clock.DATA
        if spec.clock is Clock.WALL:
            return WallTimeline(self._ticks, start, exact=self._exact)
        return DataTimeline(
            self._ticks,
            start=start,
            lateness=spec.lateness.ns,
            max_ahead=spec.max_ahead.ns,
            max_behind=_longest(self.detector),
            alone_after=spec.client_timeout.ns,
            maximum_bytes=spec.buffer.bytes.bytes,
            stamp_of=self._known.stamp_of,
            client_of=self._known.inflow.client_of,
            latched=_latched(self.detector),
            exact=self._exact,
        )


def _longest(detector: Detector) -> int:
    """How long the stream that is kept longest is kept, in nanoseconds."""
    return max(detector.spec.buffer_duration_ns(stream) for stream in detector.spec.streams)


def _latched(detector: Detector) -> frozenset[str]:
    """The streams whose samples stay valid until they are replaced."""
    return frozenset(stream.name for stream in detector.spec.streams if stream.latched)
