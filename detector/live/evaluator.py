"""The thread that drives the engine live: it reads the wall clock, drains the intake and runs due ticks.

All input of the engine passes through here in one order, and is also recorded here: arrivals, and the controls between
them (start, rules, restore, gap, level, paused, ask, plugin, end). The replay of such a recording makes the same calls.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Protocol, TypeVar

from detector.actions.base import DetectorConfiguration
from detector.assembly import RuleIndex, stream_readers
from detector.assembly.memory import Sweeper
from detector.engine.consequences import Consequence
from detector.engine.engine import Engine, NotEvaluableError
from detector.engine.episodes.demands import Demand, to_task
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import OpenEpisode
from detector.engine.evaluation.observing import Observer
from detector.engine.evaluation.rule import OnDemandResult
from detector.engine.samples.intake import Intake
from detector.engine.samples.sample import Arrival
from detector.engine.timing.schedule import LONG, Overload
from detector.engine.timing.steps import ORDER
from detector.findings.losses import Losses
from detector.live.state import RestoredState
from detector.plugins.outages import Outages
from detector.resources.selection import RuleSet
from detector.status.updating import StatusUpdater
from detector.streams.codecs.ros import RosTypes
from wayside.api import EventRule
from wayside.api.stream import Stream

_log = logging.getLogger(__name__)

Result = TypeVar("Result")

_DRAIN_EVERY = 0.1
"""Seconds between two drains of the intake, so that its queue stays short even if ticks are rare."""

_READ_EVERY = 0.05
"""The same with clock Data, where samples determine when a tick is due: how late it may be evaluated."""

_LOG_EVERY = 1.0
"""Seconds between two checks for losses: not in each cycle, because each rule and stream has counters."""

_STALL = 1_000_000_000
"""Nanoseconds: a tick that is overdue by more is skipped, and a larger step back of the clock is accepted."""

_SAVE_EVERY = 1_000_000_000
"""Nanoseconds between two writes of open episodes with statistics: a kill loses at most this part of them."""


class IntakeRecorder(Protocol):
    """Records the engine's input, in order."""

    def arrivals(self, arrivals: Sequence[Arrival]) -> None:
        """Samples that the engine takes in now."""

    def follow(self, streams: Iterable[Stream], types: RosTypes) -> None:
        """The following arrivals belong to these streams."""

    def control(self, time: int, document: Mapping[str, Any]) -> None:
        """Another input of the engine, at a time in nanoseconds since the epoch."""


class EventSink(Protocol):
    """Receives events and demands. Its methods never block."""

    def events(self, events: Sequence[Event]) -> None:
        """The starts and ends of episodes, in order."""

    def open_episodes(self, episodes: Callable[[], Sequence[OpenEpisode]]) -> None:
        """Open episodes may have changed; `episodes` returns them, and is only valid during this call."""

    def follow(self, rules: Sequence[EventRule], configuration: DetectorConfiguration) -> None:
        """These rules are evaluated from now on."""

    def consequences(self, consequences: Sequence[Consequence]) -> None:
        """The consequences for actions other than deploy, in order."""

    def demands(self, demands: Mapping[str, Demand], ended: Mapping[str, int]) -> None:
        """All demands by task name, and the ends of those that are gone (nanoseconds)."""


class LiveObserver(Observer, Protocol):
    """Observes the evaluation, on its thread. It influences no result, and never waits."""

    def attend(self, engine: Engine) -> None:
        """The engine uses other rules from now on."""

    def cycle_finished(self, engine: Engine, events: Sequence[Event]) -> None:
        """The engine has consumed the arrivals of a cycle, and these events occurred."""


class Evaluator:
    """Runs an engine on a separate thread until it is stopped."""

    def __init__(
        self,
        engine: Engine,
        intake: Intake,
        sink: EventSink,
        *,
        now: Callable[[], int],
        recorder: IntakeRecorder | None = None,
        on_failure: Callable[[BaseException], None],
        outages: Outages | None = None,
        observer: LiveObserver | None = None,
    ) -> None:
        """`now` returns nanoseconds since the epoch; `on_failure` is called if the thread dies of an error.

        `outages` are those of the engine's plugins: they are recorded for the replay.
        """
        self._engine = engine
        self._intake = intake
        self._sink = sink
        self._now = now
        self._recorder = recorder
        self._on_failure = on_failure
        self._outages = outages or Outages()
        self._observer = engine.observers.observer = observer
        self._rule_index = RuleIndex()
        self._wake = threading.Condition()
        self._wanted: RuleSet | None = None
        self._stopping = False
        self._urgent = False
        """Whether samples for rules with onSample arrived since the current cycle began."""
        self._ended = False
        self._calls: list[tuple[Future[Any], Callable[[], Any]]] = []
        self._overload = Overload()
        self._sweeper = Sweeper()
        self._saved = 0
        """When open episodes were last written, or had not changed; nanoseconds on the engine's time axis."""
        self._version: tuple[int, int] | None = None
        self._demands: dict[str, Demand] = {}
        self.losses = Losses(engine, intake)
        self.status = StatusUpdater(engine, self.losses, now)
        engine.observers.stopwatch = time.perf_counter_ns
        engine.consequences.wanted = True
        intake.on_urgent = self._hurry
        self._thread = threading.Thread(target=self._run, name="evaluator", daemon=True)

    def start(self, rule_set: RuleSet, restored: RestoredState) -> None:
        """Begin with these rules and the restored episodes; returns at once."""
        start = self._engine.now
        self._record(
            start,
            {
                "kind": "start",
                "version": ORDER,
                "holder": self._engine.identity.holder,
                "detector": rule_set.detector.to_json(),
                "rules": [rule.to_json() for rule in rule_set.rules],
            },
        )
        events = self._apply_rules(rule_set)
        if restored.demands or restored.episodes:
            self._record(
                start,
                {
                    "kind": "restore",
                    "tasks": [to_task(demand).to_json() for demand in restored.demands],
                    "episodes": [episode.to_document() for episode in restored.episodes],
                },
            )
        self._demands = {demand.name: demand for demand in restored.demands}
        events += self._engine.restore(restored.demands, start, restored.episodes)
        self._hand_over(events)
        self._sink.open_episodes(self._engine.open_episodes)
        self._thread.start()

    def call(self, work: Callable[[], Result]) -> Future[Result]:
        """Run a function on the evaluation's thread, between two cycles; thread-safe. The future has its result."""
        future: Future[Result] = Future()
        with self._wake:
            if self._ended:
                future.cancel()
            else:
                self._calls.append((future, work))
            self._wake.notify()
        return future

    def evaluate_rule(self, rule: str) -> Future[list[OnDemandResult]]:
        """Evaluate a rule with onDemand now; thread-safe. The future has a result by subject, or NotEvaluableError."""
        return self.call(lambda: self._evaluate_on_demand(rule))

    def pause_rule(self, rule: str, paused: bool) -> Future[None]:
        """Pause the rule, or (not `paused`) resume it; thread-safe.

        The future has NotEvaluableError if the rule does not exist. A restarted detector has no paused rules.
        """
        return self.call(lambda: self._pause_rule(rule, paused))

    def configure(self, rule_set: RuleSet) -> None:
        """Switch to other rules, or to another valid Detector, in the next cycle; thread-safe."""
        with self._wake:
            self._wanted = rule_set
            self._wake.notify()

    def stop(self) -> None:
        """Consume the remaining arrivals, run due ticks and end; returns when that is done."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        try:
            stopping, log_due = False, time.monotonic()
            while not stopping:
                with self._wake:
                    if self._wanted is None and not self._stopping and not self._calls and not self._urgent:
                        self._wake.wait(self.pause())
                    self._urgent = False
                    wanted, self._wanted = self._wanted, None
                    calls, self._calls = self._calls, []
                    stopping = self._stopping
                self._run_cycle(wanted)
                for future, work in calls:
                    _answer(future, work)
                self.status.cycle_finished()
                if time.monotonic() >= log_due:
                    log_due = time.monotonic() + _LOG_EVERY
                    self.losses.log_new()
                self._sweeper.run_due()
            self._finish()
            self._sink.consequences(self._engine.consequences.cut(self._engine.now, "the detector stopped"))
        except BaseException as error:  # noqa: BLE001  the supervisor must learn of any end of the evaluation
            self._on_failure(error)
        finally:
            with self._wake:
                self._ended = True
                for future, _ in self._calls:
                    future.cancel()

    def _hurry(self) -> None:
        """Drain the intake now; thread-safe."""
        if not self._urgent:  # otherwise the next cycle, which has not drained the intake yet, finds the arrivals
            with self._wake:
                self._urgent = True
                self._wake.notify()

    def _finish(self) -> None:
        """The end of input: evaluate the remaining ticks, as the replay of the recording does."""
        end = self._engine.now
        for events in self._engine.finish():
            self._hand_over(events)
        if self._engine.measures:
            self._sink.open_episodes(self._engine.open_episodes)
        self._record_outages()
        self._record(end, {"kind": "end", "finished": True})

    def pause(self) -> float:
        """Seconds until the next cycle. With clock Data only the samples determine when a tick is due."""
        if not self._engine.on_wall_clock:
            return _READ_EVERY
        return min(_DRAIN_EVERY, max(0.0, (self._engine.next_tick() - self._now()) / 1e9))

    def _run_cycle(self, wanted: RuleSet | None) -> None:
        """One cycle: consume the arrivals and run the due ticks."""
        now = self._now()
        events: list[Event] = []
        if now + _STALL < self._intake.last:
            events += self._advance(self._intake.drain(self._intake.last), self._intake.last)
            self._intake.step_back(now)
            events += self._gap(now, "the wall clock stepped back")
        else:
            if now - self._engine.next_tick() > _STALL and self._engine.on_wall_clock:
                events += self._gap(now, "the evaluation stalled, or the wall clock stepped forward")
            events += self._advance(self._intake.drain(now), now)
        if wanted is not None:
            events += self._configure(wanted)
        self._hand_over(events)

    def _evaluate_on_demand(self, rule: str) -> list[OnDemandResult]:
        events, answers = self._engine.evaluate_now(rule)
        self._record(self._engine.now, {"kind": "ask", "rule": rule})
        self._hand_over(events)
        return answers

    def _pause_rule(self, rule: str, paused: bool) -> None:
        if rule not in self._engine.rules:
            raise NotEvaluableError(
                f"there is no rule {rule}; the detector has {', '.join(sorted(self._engine.rules)) or 'none'}"
            )
        names = self._engine.schedule.paused - {rule} | ({rule} if paused else set())
        self._record(self._engine.now, {"kind": "paused", "rules": sorted(names)})
        self._engine.set_paused(names)
        _log.info("EventRule %s is %s", rule, "paused; its open episodes are kept" if paused else "evaluated again")

    def _adapt(self, spent: int) -> None:
        """Raise the level of thinning after a slow cycle, and lower it once cycles are fast again."""
        if self._overload.observe(self._now(), spent, self._engine.schedule.highest):
            level, highest = self._overload.level, self._engine.schedule.highest
            text = "the evaluation is overloaded" if spent > LONG else "the evaluation is fast enough again"
            _log.warning(
                "%s: evaluations of low-priority rules are skipped at level %d of %d",
                text,
                level,
                highest,
            )
            self._record(self._engine.now, {"kind": "level", "level": level})
            self._engine.set_level(level)

    def _advance(self, arrivals: list[Arrival], now: int) -> list[Event]:
        if self._recorder is not None and arrivals:
            self._recorder.arrivals(arrivals)
        self.status.arrived(arrivals)
        begin = self._engine.observers.stopwatch()
        events = self._engine.advance(arrivals, now)
        self._record_outages()
        self._adapt(self._engine.observers.stopwatch() - begin)
        return events

    def _record_outages(self) -> None:
        for document in self._outages.take_changes():
            self._record(self._engine.now, document)

    def _gap(self, now: int, why: str) -> list[Event]:
        _log.warning("%s: skipping missed ticks; windows reset, open episodes kept", why)
        self.status.gaps += 1
        self._record(now, {"kind": "gap", "until": self._engine.now})
        return self._engine.gap(now)

    def _configure(self, wanted: RuleSet) -> list[Event]:
        """Switch to a changed Detector or rules."""
        changed = wanted.detector.spec != self._engine.detector.spec
        if changed:
            readers = stream_readers(wanted.detector)
            self._engine.set_detector(wanted.detector, readers.decoders, readers.read_key)
            if self._recorder is not None:
                self._recorder.follow(wanted.detector.spec.streams, readers.types)
        self._record(
            self._engine.now,
            {
                "kind": "rules",
                "rules": [rule.to_json() for rule in wanted.rules],
                **({"detector": wanted.detector.to_json()} if changed else {}),
            },
        )
        return self._apply_rules(wanted)

    def _apply_rules(self, rule_set: RuleSet) -> list[Event]:
        readers = stream_readers(rule_set.detector)
        compiled, refused = self._rule_index.compile(rule_set.rules, rule_set.detector, readers.fields, readers.places)
        for refusal in refused:
            _log.error("%s", refusal)
        self.status.refused(refused)
        self._sink.follow(
            self._rule_index.good, DetectorConfiguration(rule_set.detector, readers.decoders, readers.types)
        )
        events = self._engine.set_rules(compiled)
        if self._observer is not None:
            self._observer.attend(self._engine)
        self._intake.urgent = self._engine.triggers
        return events

    def _hand_over(self, events: Sequence[Event]) -> None:
        if self._observer is not None:
            self._observer.cycle_finished(self._engine, events)
        if events:
            self._sink.events(events)
        if events or abs(self._engine.now - self._saved) >= _SAVE_EVERY:
            self._saved = self._engine.now
            if events or self._engine.measures:
                self._sink.open_episodes(self._engine.open_episodes)
        if consequences := self._engine.consequences.drain(self._engine.now):
            self._sink.consequences(consequences)
        version = self._engine.demands_version
        if version != self._version:
            self._version = version
            demands = self._engine.demands()
            ends = {event.episode.id: event.end_time for event in events if event.end_time is not None}
            ended = {
                name: ends.get(demand.episode.id, self._engine.now)
                for name, demand in self._demands.items()
                if name not in demands
            }
            self._demands = demands
            self.status.demands = (*demands,)
            self._sink.demands(demands, ended)

    def _record(self, time: int, document: Mapping[str, Any]) -> None:
        if self._recorder is not None:
            self._recorder.control(time, document)


def _answer(future: Future[Any], work: Callable[[], Any]) -> None:
    """Carry out a call; its error goes to the caller and does not end the evaluation."""
    if future.set_running_or_notify_cancel():
        try:
            future.set_result(work())
        except Exception as error:  # noqa: BLE001  passed to the caller
            future.set_exception(error)
