"""Replays recordings through the same engine that runs live.

An intake file contains the input of a live engine, including controls: its replay makes the same calls and gives the
same events, byte by byte. Any other recording is a series of messages; its replay gives the same events each time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

from detector.actions.base import DetectorConfiguration
from detector.assembly import RefusedRule, RuleIndex, StreamReaders, make_engine, stream_readers
from detector.engine.engine import Engine, NotEvaluableError
from detector.engine.episodes.demands import Demand, from_task, to_task
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import OpenEpisode, from_document
from detector.engine.evaluation.observing import Observer
from detector.engine.samples.sample import Arrival
from detector.engine.scoping.plugins import PluginHost
from detector.engine.timing.steps import ORDER
from detector.findings.losses import Losses
from detector.replay.batches import PAUSE, parts_of
from detector.replay.clips import Clips, Recorders
from detector.replay.intake_file import Control, detector_as_of, rule_as_of
from detector.replay.message import RecordingError, Truncation
from wayside.api import ApplicationTask, Detector, EventRule
from wayside.findings import Finding
from wayside.times import format_time

_BATCH = 4096


class ReplayObserver(Observer, Protocol):
    """Observes the evaluation of a replay. It influences no result."""

    def attend(self, engine: Engine) -> None:
        """The engine uses other rules from now on."""


@dataclass(slots=True)
class ReplayResult:
    """The outcome of a replay."""

    events: list[Event] = field(default_factory=list)
    tasks: dict[str, ApplicationTask] = field(default_factory=dict)
    refusals: list[RefusedRule] = field(default_factory=list)
    samples: int = 0
    notes: list[str] = field(default_factory=list)
    """Notes for the user: pauses, losses, unknown values and failures."""
    cuts: list[Truncation] = field(default_factory=list)
    """Truncated files of the recording."""
    doubts: list[Finding] = field(default_factory=list)
    """Stamps that do not fit the clock, many old samples, streams that become stale between their samples."""
    cut: bool = False
    """The intake file is incomplete: its writer was killed."""
    end: int = 0
    """All ticks up to this time have run; nanoseconds since the epoch."""
    rules: dict[str, EventRule] = field(default_factory=dict)
    """All rules of the replay in their last version, by name."""
    lost: int = 0
    """Arrivals missing from the intake file: the disk was too slow for them."""


class Replay:
    """An engine, and the records of its results."""

    def __init__(
        self,
        detector: Detector,
        rules: Sequence[EventRule],
        *,
        holder: str,
        start: int,
        outcome: ReplayResult,
        plugins: PluginHost | None = None,
        version: int = ORDER,
        order: int = ORDER,
        observer: ReplayObserver | None = None,
        clips: Clips | None = None,
    ) -> None:
        """`start` is when the detector started, in nanoseconds since the epoch; `plugins` runs them.

        `version` is that of the intake file with the rules; `order`: see `steps.ORDER`. With `clips`, the rules'
        record actions run.

        Raises:
            DetectorError: the Detector cannot run.
        """
        self.outcome = outcome
        self._version = version
        self._clips = clips
        self._recorders: Recorders | None = None if clips is None else clips.recorders(holder)
        self._detector = detector = detector if clips is None else clips.placed(detector)
        self._readers: StreamReaders = stream_readers(detector)
        self._rule_index = RuleIndex()
        self._engine: Engine = make_engine(
            detector, self._readers, holder=holder, start=start, plugins=plugins, order=order
        )
        self._engine.counters.watch_ages = True
        self._engine.observers.journal = []
        self._engine.consequences.wanted = clips is not None
        self._engine.observers.observer = self._observer = observer
        self._demands: dict[str, Demand] = {}
        self._demands_version: tuple[int, int] | None = None
        self.set_rules(rules)

    def advance(self, arrivals: Sequence[Arrival], until: int) -> None:
        """Advance the engine with these arrivals: see `Engine.advance`."""
        self.outcome.samples += len(arrivals)
        self._note(self._engine.advance(arrivals, until))

    @property
    def version(self) -> int:
        """The version of the intake file."""
        return self._version

    @property
    def engine(self) -> Engine:
        """The driven engine."""
        return self._engine

    def evaluate_rule(self, rule: str) -> None:
        """A rule was evaluated on demand; if other rules were recorded, it may not exist here."""
        with contextlib.suppress(NotEvaluableError):
            self._note(self._engine.evaluate_now(rule)[0])

    def finish(self) -> None:
        """No more samples follow: run the remaining evaluations."""
        for events in self._engine.finish():
            self._note(events)

    def close(self) -> None:
        """The recording is over: complete the clips."""
        if self._recorders is not None:
            self._recorders.dispatch(self._engine.consequences.cut(self._engine.now, "the recording ended"))
            self.outcome.notes += self._recorders.close()

    def gap(self, time: int) -> None:
        """Time jumped without ticks."""
        self._note(self._engine.gap(time))

    def set_detector(self, detector: Detector) -> None:
        """Switch to a changed Detector; `set_rules` follows."""
        self._detector = detector = detector if self._clips is None else self._clips.placed(detector)
        self._readers = stream_readers(detector)
        self._engine.set_detector(detector, self._readers.decoders, self._readers.read_key)

    def set_rules(self, rules: Sequence[EventRule]) -> None:
        """Switch to these rules."""
        compiled, refused = self._rule_index.compile(rules, self._detector, self._readers.fields, self._readers.places)
        self.outcome.refusals += refused
        self.outcome.rules |= {rule.name: rule for rule in rules}
        if self._recorders is not None:
            configuration = DetectorConfiguration(self._detector, self._readers.decoders, self._readers.types)
            self._recorders.follow(self._rule_index.good, configuration)
        self._note(self._engine.set_rules([rule_as_of(rule, self._version) for rule in compiled]))
        if self._observer is not None:
            self._observer.attend(self._engine)

    def restore(self, demands: Sequence[Demand], time: int, episodes: Sequence[OpenEpisode] = ()) -> None:
        """Restore the episodes that were open before the recording."""
        for demand in demands:
            self._demands[demand.name] = demand
            self.outcome.tasks[demand.name] = to_task(demand)
        self._note(self._engine.restore(demands, time, episodes))

    def report(self) -> Iterator[str]:
        """The losses and a summary of the evaluations, one line each."""
        losses = Losses(self._engine)
        self.outcome.doubts += losses.doubts()
        return losses.report()

    def _note(self, events: list[Event]) -> None:
        self.outcome.events += events
        self.outcome.end = max(self.outcome.end, self._engine.now)
        self._note_changes()
        if self._recorders is not None:
            self._recorders.dispatch(self._engine.consequences.drain(self._engine.now))
        if self._engine.demands_version == self._demands_version:
            return
        self._demands_version = self._engine.demands_version
        demands = self._engine.demands()
        ends = {event.episode.id: event.end_time for event in events if event.end_time is not None}
        for name in self._demands.keys() - demands.keys():
            demand = self._demands[name]
            self.outcome.tasks[name] = to_task(demand, ends.get(demand.episode.id, self._engine.now))
        for name, demand in demands.items():
            if self._demands.get(name) != demand:
                self.outcome.tasks[name] = to_task(demand)
        self._demands = demands

    def _note_changes(self) -> None:
        """Note changes of demands since the last call: one that began and ended in between is a task as well."""
        journal = self._engine.observers.journal or []
        changed = {change.demand.name: change for change in journal}
        for name, (_, demand, end) in changed.items():
            self.outcome.tasks[name] = to_task(demand, end)
            if end is None:
                self._demands[name] = demand
            else:
                self._demands.pop(name, None)
        journal.clear()


def replay_intake(
    records: Iterable[Arrival | Control],
    detector: Detector | None,
    rules: Sequence[EventRule] | None,
    plugins: PluginHost | None = None,
    observer: ReplayObserver | None = None,
    clips: Clips | None = None,
) -> ReplayResult:
    """Replay an intake file with its own Detector and rules, or with others if given.

    `plugins` runs them; without it they run in this process. With `clips`, record actions run.

    Raises:
        RecordingError: it does not begin with a start.
        DetectorError: the Detector cannot run.
    """
    outcome = ReplayResult()
    replay: Replay | None = None
    batch: list[Arrival] = []
    for record in records:
        if isinstance(record, Arrival):
            if len(batch) >= _BATCH and replay is not None and record.received > batch[-1].received:
                replay.advance(batch, batch[-1].received)
                batch = []
            batch.append(record)
            continue
        if replay is None:
            replay = _begin(record, detector, rules, outcome, plugins, observer, clips)
            continue
        replay.advance(batch, _until(record, batch))
        batch = []
        _control(replay, record, detector, rules, outcome)
    if replay is not None:
        replay.close()
        outcome.notes += replay.report()
    else:
        raise RecordingError("the intake file is empty: its writer was killed before it wrote anything; record again")
    return outcome


def _until(control: Control, batch: Sequence[Arrival]) -> int:
    """The engine's time at which it received the control."""
    if control.kind in ("cut", "lost"):
        return batch[-1].received if batch else 0
    return int(control.document.get("until", control.time))


def _begin(
    record: Control,
    detector: Detector | None,
    rules: Sequence[EventRule] | None,
    outcome: ReplayResult,
    plugins: PluginHost | None,
    observer: ReplayObserver | None,
    clips: Clips | None,
) -> Replay:
    document = record.document
    if record.kind != "start":
        raise RecordingError(f"the intake file must begin with a start record; got {record.kind!r}: record again")
    version = int(document.get("version", 1))
    return Replay(
        detector or Detector.model_validate(detector_as_of(document["detector"], version)),
        _rules(document) if rules is None else rules,
        holder=document["holder"],
        start=record.time,
        outcome=outcome,
        plugins=plugins,
        version=version if rules is None else ORDER,
        order=version,
        observer=observer,
        clips=clips,
    )


def _control(
    replay: Replay, record: Control, detector: Detector | None, rules: Sequence[EventRule] | None, outcome: ReplayResult
) -> None:
    document = record.document
    match record.kind:
        case "restore":
            tasks = [ApplicationTask.model_validate(task) for task in document["tasks"]]
            demands = [demand for task in tasks if (demand := from_task(task)) is not None]
            replay.restore(demands, record.time, [from_document(each) for each in document.get("episodes", ())])
        case "rules":
            if detector is None and "detector" in document:
                replay.set_detector(Detector.model_validate(detector_as_of(document["detector"], replay.version)))
            if rules is None:
                replay.set_rules(_rules(document))
        case "gap":
            replay.gap(record.time)
        case "level":
            replay.engine.set_level(int(document["level"]))
        case "paused":
            replay.engine.set_paused(frozenset(document["rules"]))
        case "ask":
            replay.evaluate_rule(str(document["rule"]))
        case "cut":
            outcome.cut = True
        case "lost":
            outcome.lost += int(document["arrivals"])
        case "end":
            if document.get("finished"):  # older files lack it: the last `lateness` was not evaluated
                replay.finish()
        case _:
            pass  # plugin: their host knows it already


def _rules(document: Mapping[str, Any]) -> list[EventRule]:
    return [EventRule.model_validate(rule) for rule in document["rules"]]


def replay_arrivals(
    batches: Iterable[Sequence[Arrival]],
    detector: Detector,
    rules: Sequence[EventRule],
    plugins: PluginHost | None = None,
    holder: str | None = None,
    observer: ReplayObserver | None = None,
    clips: Clips | None = None,
) -> ReplayResult:
    """Replay any other recording in the way the live intake would have queued it; `plugins` as for an intake file.

    Args:
        batches: the arrivals, whose times never go back; the boundaries of batches have no meaning.
        holder: the holder to run as; by default the Detector's name.
        clips: where record actions write; None: they do not run.

    Raises:
        DetectorError: the Detector cannot run.
    """
    outcome = ReplayResult()
    replay: Replay | None = None
    last = 0
    begin = partial(
        Replay,
        detector,
        rules,
        holder=holder or detector.name,
        outcome=outcome,
        plugins=plugins,
        observer=observer,
        clips=clips,
    )
    for part in parts_of(batches):
        first = part[0].received
        if replay is None:
            replay = begin(start=first - 1)
        elif first - last > PAUSE:
            replay.gap(first - 1)
            outcome.notes.append(
                f"the recording pauses after {format_time(last)} for {(first - last) / 1e9:.0f} s: "
                "nothing is evaluated in between, windows reset, open episodes are kept"
            )
        last = part[-1].received
        replay.advance(part, last)
    if replay is None:
        replay = begin(start=0)
        replay.advance((), 0)
    replay.finish()
    replay.close()
    outcome.notes += replay.report()
    return outcome
