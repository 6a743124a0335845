"""The engine: arrivals and the time go in, events come out, and the demands of open episodes can be read.

It reads no clock and does no I/O. Live operation, the replay of a recording and the tests call the same methods
(`advance`, `gap`, `set_rules`, `restore`, `finish`), always from one thread; the same calls give the same events, ids
included.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import msgspec

from detector.engine.buffering.messages import KeyReader
from detector.engine.consequences import Consequences
from detector.engine.counters import Counters
from detector.engine.episodes.current import DetectorIdentity
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.episodes import EndReason
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord, OpenEpisode
from detector.engine.evaluation.executor import Executor
from detector.engine.evaluation.inputs import RuleInputs
from detector.engine.evaluation.observing import Observers
from detector.engine.evaluation.rule import OnDemandResult, RuleRun, same_semantics
from detector.engine.queries.queries import BufferQueries
from detector.engine.samples.sample import Arrival, Decoder, Sample
from detector.engine.scoping.plugins import NoPlugins, PluginHost, PluginSignals
from detector.engine.signals.starts import EpisodeStarts
from detector.engine.timing.data import DataTimeline
from detector.engine.timing.schedule import Schedule, Ticks
from detector.engine.timing.steps import ORDER
from detector.engine.timing.wall import WallTimeline
from wayside.api import Detector
from wayside.api.detector import Clock
from wayside.rules import CompiledRule, in_order

__all__ = ["Engine", "KeyReader"]


class NotEvaluableError(ValueError):
    """A rule cannot be evaluated on demand; the text names the reason and the remedy."""


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

        `plugins` runs them; without it, their signals are unknown. `order`: see `steps.ORDER`.

        Raises:
            RuleError: an expression of one of the Detector's streams does not compile.
        """
        self.identity = DetectorIdentity(detector.name, holder, detector.namespace)
        self.counters = Counters()
        self._runs: dict[str, RuleRun] = {}
        self._rules_version = 0
        self._deploying: list[RuleRun] = []
        """The rules whose episodes have demands."""
        self._exact = order >= ORDER
        self._ticks = Ticks()
        self.schedule = Schedule(self._ticks)
        self._starts = EpisodeStarts()
        self._inputs = RuleInputs(detector, decoders, read_key, start, self.counters, self._starts, exact=self._exact)
        self.buffer, self.clients = self._inputs.buffer, self._inputs.clients
        self._starts.is_known = self.clients.__contains__
        self._plugins = PluginSignals(plugins or NoPlugins(), self.queries)
        self.consequences = Consequences(self.buffer)
        """The messages for all actions except deploy."""
        self._timeline = self._make_timeline(start)
        self.observers = Observers()
        """Observers; set them before the rules."""
        self._executor = Executor(
            self._inputs,
            self._ticks,
            self.schedule,
            self._starts,
            self._plugins,
            self.consequences,
            self.observers,
            lambda: self._timeline.now,
        )

    def set_detector(self, detector: Detector, decoders: Mapping[str, Decoder], read_key: KeyReader) -> None:
        """Switch to a changed Detector; call `set_rules` afterwards, with the rules compiled against it.

        Samples of streams that are read as before are kept, and so are open episodes. A change of the clock begins a
        new time axis: the buffer is emptied and pending episodes are discarded.

        Raises:
            RuleError: an expression of one of the Detector's streams does not compile; the engine is then unchanged.
        """
        before = self.detector.spec
        self._inputs.follow(detector, decoders, read_key, self._timeline.now)
        self._executor.follow_detector()
        if isinstance(self._timeline, DataTimeline):
            self._timeline.max_behind = _longest(detector)
            self._timeline.latched = _latched(detector)
            self._timeline.alone_after = detector.spec.client_timeout.ns
            self._timeline.maximum_bytes = detector.spec.buffer.bytes.bytes
        times = (detector.spec.clock, detector.spec.lateness, detector.spec.max_ahead)
        if times != (before.clock, before.lateness, before.max_ahead):
            self._executor.run(self._timeline.rest())
            now = self._timeline.now
            self._timeline = self._make_timeline(now)
            self._executor.gap(now, backwards=detector.spec.clock is not before.clock)

    @property
    def detector(self) -> Detector:
        """The Detector in its current version."""
        return self._inputs.detector

    def advance(self, arrivals: Sequence[Arrival], until: int) -> list[Event]:
        """Insert the arrivals, in order, and run the ticks up to `until`, or to the last arrival if that is later.

        Arrivals of equal time come in one call: those of a later call are later than all of these and than `until`.
        """
        return self._executor.run(self._timeline.steps(arrivals, until))

    def finish(self) -> Iterator[list[Event]]:
        """No more samples follow: run the remaining evaluations, step by step. With clock Wall there are none.

        Between two steps, the demands that are open at that time can be read.
        """
        for step in self._timeline.finish():
            yield self._executor.run((step,))

    def gap(self, time: int) -> list[Event]:
        """The wall clock was stopped or jumped: continue at `time`; windows reset, open episodes are kept."""
        return self._executor.run(self._timeline.gap(time))

    def set_rules(self, rules: Sequence[CompiledRule]) -> list[Event]:
        """Evaluate these rules from now on. Episodes of removed rules, and of rules whose semantics changed, end."""
        now = self._timeline.now
        new = {rule.name: rule for rule in rules}
        events: list[Event] = []
        runs: dict[str, RuleRun] = {}
        kept: set[str] = set()
        for name, run in sorted(self._runs.items()):
            rule = new.get(name)
            if rule is None or not same_semantics(run, rule):
                events += self._executor.noted(run, run.end_all(now, EndReason.RULE_CHANGED))
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
        self._inputs.forget_rules(kept)
        self._inputs.ingest.linked = frozenset(stream for rule in rules for stream in rule.linked)
        self._plugins.configure(rules, kept)
        self.schedule.set_rules([run.rule for run in self._runs.values()])
        self._executor.set_rules(self._runs)
        self._deploying = [run for run in self._runs.values() if run.rule.deploys]
        self._rules_version += 1
        return events

    def restore(self, demands: Sequence[Demand], now: int, episodes: Sequence[OpenEpisode] = ()) -> list[Event]:
        """Restore the episodes that were open before a restart; those whose rule changed meanwhile end.

        The episodes of the demands come first, then those of `episodes` without demands. Statistics are taken from
        `episodes`.
        """
        demanded: dict[tuple[str, str, str], list[Demand]] = {}
        for demand in demands:
            demanded.setdefault((demand.episode.rule, demand.episode.subject, demand.episode.id), []).append(demand)
        statistics = {episode.record.id: episode.statistics for episode in episodes}
        events: list[Event] = []
        for _, of_one in sorted(demanded.items()):
            record = of_one[0].episode
            if record.subject == record.about.text:
                events += self._restore(OpenEpisode(record, statistics.get(record.id)), of_one, now)
            else:  # the text is part of the event's key
                record = msgspec.structs.replace(record, subject=record.about.text)
                events.append(self._ended_while_away(record, now))
        known = {demand.episode.id for demand in demands}
        for episode in sorted(episodes, key=lambda each: (each.record.rule, each.record.subject, each.record.id)):
            if episode.record.id not in known:
                events += self._restore(episode, (), now)
        self._rules_version += 1
        return events

    def _restore(self, episode: OpenEpisode, demands: Sequence[Demand], now: int) -> list[Event]:
        record = episode.record
        run = self._runs.get(record.rule)
        if run is None or not run.can_restore(record):
            return [self._ended_while_away(record, now)]
        event = run.restore(episode, demands)
        self._starts.started(event)
        self.consequences.begin(run.rule.actions, run.rule, event, resumed=True)
        for client in record.clients:
            self.clients.restore(client, now)
        return []

    def _ended_while_away(self, record: EpisodeRecord, now: int) -> Event:
        """The end of an episode whose rule changed or was removed while the detector was not running."""
        return Event(self.identity.holder, record, {}, now, EndReason.RULE_CHANGED)

    def open_episodes(self) -> list[OpenEpisode]:
        """All episodes that have not ended."""
        return [episode for run in self._runs.values() for episode in run.episodes()]

    @property
    def measures(self) -> bool:
        """Whether an open episode has statistics, which any evaluation may change."""
        return any(run.measured for run in self._runs.values())

    def set_paused(self, names: Collection[str]) -> None:
        """Pause these rules and resume all others; unknown names are ignored.

        Open episodes of a paused rule are kept, pending ones are discarded.
        """
        for name in self._runs.keys() & names:
            self._runs[name].forget_pending()
        self.schedule.paused = frozenset(self._runs.keys() & names)
        self._executor.plan()
        self._executor.wake_all(self.now)

    def set_level(self, level: int) -> None:
        """Set the level of thinning (see schedule.py); 0: evaluate everything."""
        self.schedule.set_level(level)
        self._executor.plan()

    def evaluate_now(self, name: str) -> tuple[list[Event], list[OnDemandResult]]:
        """Evaluate a rule with `onDemand` now: after the last tick, with the samples inserted since, up to `now`.

        Returns the episodes that started and ended, and the result for each subject.

        Raises:
            NotEvaluableError: the rule does not exist, has no `onDemand`, or is disabled or paused.
        """
        run = self._runs.get(name)
        if run is None:
            raise NotEvaluableError(
                f"there is no rule {name}; the detector has {', '.join(sorted(self._runs)) or 'none'}"
            )
        if not run.rule.on_demand:
            raise NotEvaluableError(f"rule {name} is not evaluated on demand: write evaluation: {{onDemand: true}}")
        if not run.rule.enabled or name in self.schedule.paused:
            raise NotEvaluableError(f"rule {name} is {'paused: resume it' if run.rule.enabled else 'not enabled'}")
        events, answers = run.answer(self.now, self._inputs.views(run, self.now), self.clients, self._plugins)
        self._executor.noted(run, events)
        self._inputs.end_tick(self.now)
        return events, answers

    def demands(self) -> dict[str, Demand]:
        """The demands of open episodes, by the names of their tasks."""
        return {demand.name: demand for run in self._runs.values() for demand in run.demands()}

    @property
    def demands_version(self) -> tuple[int, int]:
        """Changes whenever the demands do, so that a caller reads them again only then."""
        return self._rules_version, sum(run.version for run in self._deploying)

    def next_tick(self) -> int:
        """When the next tick is due, with clock Wall; nanoseconds since the epoch."""
        return self._ticks.after(self._timeline.now)

    @property
    def triggers(self) -> frozenset[str]:
        """The streams whose samples trigger evaluations."""
        return self._ticks.triggers

    @property
    def now(self) -> int:
        """All ticks up to this time have run; nanoseconds on the engine's time axis."""
        return self._timeline.now

    @property
    def on_wall_clock(self) -> bool:
        """Whether the caller advances time; otherwise the samples do."""
        return isinstance(self._timeline, WallTimeline)

    @property
    def timeline(self) -> WallTimeline | DataTimeline:
        """The time axis; with clock Data it counts dropped samples."""
        return self._timeline

    def latency(self, sample: Sample, stream: str) -> float | None:
        """Seconds from the sample's stamp to its receipt; None if it has no stamp. Counts nothing."""
        return self._inputs.latency(sample, stream)

    @property
    def in_columns(self) -> frozenset[str]:
        """The rules that are evaluated in columns and therefore reported to the observer."""
        return self._executor.in_columns

    @property
    def rules(self) -> Mapping[str, RuleRun]:
        """The rules that are evaluated, by name."""
        return self._runs

    def queries(self) -> BufferQueries:
        """Read access to the buffer in its current state."""
        return self._inputs.queries(self.now)

    def _make_timeline(self, start: int) -> WallTimeline | DataTimeline:
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
            stamp_of=self._inputs.stamp_of,
            client_of=self._inputs.ingest.sender_of,
            latched=_latched(self.detector),
            exact=self._exact,
        )


def _longest(detector: Detector) -> int:
    """The longest retention of all streams, in nanoseconds."""
    return max(detector.spec.buffer_duration_ns(stream) for stream in detector.spec.streams)


def _latched(detector: Detector) -> frozenset[str]:
    """The streams whose samples stay valid until they are replaced."""
    return frozenset(stream.name for stream in detector.spec.streams if stream.latched)
