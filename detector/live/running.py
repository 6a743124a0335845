"""A running detector: intake, evaluation, network, event log and recording, connected, started and stopped in order."""

from __future__ import annotations

import asyncio
import logging
import re
import threading
import time
from collections.abc import AsyncIterator, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from detector.actions.deploy.reconciler import DemandReconciler
from detector.actions.outcomes import Outcomes
from detector.actions.tracing import EpisodeTraces
from detector.assembly import DetectorError, StreamReaders, make_engine, stream_readers
from detector.engine.samples.intake import Intake, Put
from detector.engine.samples.liveliness import LIVELINESS
from detector.findings.losses import Loss, of_streams
from detector.live.answers import Answers
from detector.live.evaluator import Evaluator, LiveObserver
from detector.live.requested import RequestedRecordings
from detector.live.sink import EventLog, LiveSink
from detector.live.state import RestoredState, StateFile
from detector.plugins.processes import ProcessHost
from detector.resources.selection import RuleSet
from detector.sources.registry import source_plugin_problems
from detector.sources.supervision import Sources
from detector.status.server import PagesAddress, StatusServer
from detector.streams.loss_counter import LossCounter
from detector.streams.query_handler import QueryHandler
from detector.streams.zenoh import Network
from wayside.api import Detector
from wayside.api.plugin import ZENOH
from wayside.api.stream import Stream

if TYPE_CHECKING:
    from detector.actions.deploy.lease import HolderLease
    from detector.replay.intake_writer import IntakeWriter

_log = logging.getLogger(__name__)


class EvaluationView(LiveObserver, Protocol):
    """Displays the evaluation to users."""

    @property
    def port(self) -> int:
        """The port on which it is served."""

    def losses(self) -> Iterable[Loss]:
        """Number of items that were not shown."""

    def close(self) -> None:
        """Stop it."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The outputs of a run: files, pages and the live view."""

    output: Path | None = None
    """The folder of events.jsonl."""
    record_intake: Path | None = None
    pages: PagesAddress | None = None
    """The address of /metrics, /healthz and /readyz; None: not served."""
    view: EvaluationView | None = None


class Running:
    """A context manager: the detector's threads run inside the `with` block."""

    def __init__(
        self,
        rule_set: RuleSet,
        holder: str,
        reconciler: DemandReconciler,
        restored: RestoredState,
        options: RunOptions,
        *,
        state: StateFile | None = None,
        traces: EpisodeTraces | None = None,
        lease: HolderLease | None = None,
    ) -> None:
        """Start nothing; `with` does.

        Raises:
            DetectorError: the Detector cannot run.
            OSError: a file or the port is unavailable.
            CertificateError: the pages have no valid certificate.
        """
        self._loop = asyncio.get_running_loop()
        self._failed: asyncio.Future[None] = self._loop.create_future()
        self._rule_set = rule_set
        self._restored = restored
        detector = rule_set.detector
        readers = _checked(detector)
        self._loss_counter = LossCounter()
        self._intake = Intake(time.time_ns)
        self._plugins = ProcessHost()
        self._engine = make_engine(detector, readers, holder=holder, start=time.time_ns(), plugins=self._plugins)
        self._writer = None if options.record_intake is None else _writer(options.record_intake, detector, readers)
        self._log = None if options.output is None else EventLog(options.output / "events.jsonl")
        self._sink = LiveSink(self._network(detector), holder, self._log, reconciler, state, traces)
        self._state = state
        self._reconciler = reconciler
        self._evaluator = Evaluator(
            self._engine,
            self._intake,
            self._sink,
            now=time.time_ns,
            recorder=self._writer,
            on_failure=self._fail,
            outages=self._plugins.outages,
            observer=options.view,
        )
        requested = RequestedRecordings(self._engine, self._evaluator.call)
        self._sink.actions.outcomes.on_outcome = requested.on_outcome
        self._sources = Sources(self._intake.putter, self._loss_counter)
        loop_silence = LoopMonitor(self._loop).silence
        self.answers = Answers(self._evaluator, self._sink, self._sources, requested, loop_silence, lease)
        self._server = None if options.pages is None else _server(options.pages, self.answers)
        self._view = options.view

        watch = self._evaluator.losses.watch
        watch(lambda: of_streams(self._loss_counter))
        watch(lambda: _of_actions(self._sink.actions.outcomes))
        if state is not None:
            watch(lambda: _of_state(state))
        if options.view is not None:
            watch(options.view.losses)
        if traces is not None:
            watch(lambda: _of_traces(traces))

    def __enter__(self) -> Running:
        self._evaluator.start(self._rule_set, self._restored)
        self._sink.network.start()
        self._sources.follow(self._rule_set.detector)
        if self._server is not None:
            self._server.start()
            _log.info("serving /metrics, /healthz and /readyz on port %d", self._server.port)
        if self._view is not None:
            _log.info("serving the live view on port %d", self._view.port)
        _log.info(
            "Detector %s runs with %d rules and %d restored demands",
            self._rule_set.detector.name,
            len(self._engine.rules),
            len(self._restored.demands),
        )
        if self._restored.episodes:
            _log.info("restored %d open episodes from the state volume", len(self._restored.episodes))
        return self

    def __exit__(self, *_: object) -> None:
        self._sources.close()
        if self._server is not None:
            self._server.close()
        self._evaluator.stop()
        if self._view is not None:
            self._view.close()
        self._plugins.close()
        self._sink.actions.close()
        if self._state is not None:
            self._state.close()
        self._sink.network.close()
        if self._log is not None:
            self._log.close()
        if self._writer is not None:
            self._writer.close()
        self._summarise()

    async def run(self, changes: AsyncIterator[RuleSet], stopping: asyncio.Event) -> None:
        """Run, with the reconciler, and apply each change, until `stopping` is set."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._reconciler.run())
            try:
                with self:
                    following = group.create_task(self.follow(changes))
                    await self._until(stopping)
                    following.cancel()
            finally:
                self._reconciler.stop()

    async def _until(self, stopping: asyncio.Event) -> None:
        """Wait for the end. Raises the error that ended the evaluation, if any."""
        async with asyncio.TaskGroup() as group:
            ending = group.create_task(stopping.wait())
            self._failed.add_done_callback(lambda _: ending.cancel())
        if self._failed.done():
            self._failed.result()

    async def follow(self, changes: AsyncIterator[RuleSet]) -> None:
        """Apply each change of the Detector and its rules."""
        async for wanted in changes:
            detector, before = self._good(wanted.detector), self._rule_set.detector.spec
            self._rule_set = replace(wanted, detector=detector)
            self._evaluator.configure(self._rule_set)
            _log.info("applied a change: Detector %s runs with %d rules", detector.name, len(wanted.rules))
            spec = detector.spec
            if spec.zenoh != before.zenoh or _subscribed(spec.streams) != _subscribed(before.streams):
                await asyncio.to_thread(self._sink.switch_network, self._network(detector))
            await asyncio.to_thread(self._sources.follow, detector)

    def _network(self, detector: Detector) -> Network:
        spec = detector.spec
        streams = [stream for stream in spec.streams if stream.source == ZENOH]
        holder = self._engine.identity.holder
        return Network(
            spec.zenoh,
            streams,
            self._putter,
            on_failure=self._fail,
            make_query_handler=lambda session: QueryHandler(session, holder, self.answers.answer),
            loss_counter=self._loss_counter,
        )

    def _putter(self, stream: str) -> Put:
        """The inputs for the messages of a stream; changes of tokens wait for room before they are dropped."""
        return self._intake.blocking_putter(stream) if stream == LIVELINESS else self._intake.putter(stream)

    def _good(self, wanted: Detector) -> Detector:
        """The changed Detector, or the last good one if it cannot run."""
        try:
            _checked(wanted)
        except DetectorError as error:
            _log.error("cannot apply the new Detector %s; keeping the last good one: %s", wanted.name, error)
            return self._rule_set.detector
        return wanted

    def _fail(self, error: BaseException) -> None:
        def notify() -> None:
            if not self._failed.done():
                self._failed.set_exception(error)

        self._loop.call_soon_threadsafe(notify)

    def _summarise(self) -> None:
        self._evaluator.losses.sum_up()
        if self._sink.network.dropped_events:
            _log.warning("in total, %d events were not published", self._sink.network.dropped_events)


def _writer(path: Path, detector: Detector, readers: StreamReaders) -> IntakeWriter:
    # Not at the top: only a detector that records its intake needs the MCAP library.
    from detector.replay.intake_writer import IntakeWriter  # noqa: PLC0415

    return IntakeWriter(_unused(path), detector.spec.streams, readers.types)


def _server(address: PagesAddress, answers: Answers) -> StatusServer:
    # Not at the top: only a detector that is scraped needs the import.
    from detector.status.metrics import Metrics  # noqa: PLC0415

    metrics = Metrics(answers.status)
    return StatusServer(
        address, {"/metrics": lambda: (True, metrics.text()), "/healthz": answers.healthy, "/readyz": answers.ready}
    )


def _of_state(state: StateFile) -> Iterator[Loss]:
    """Failures to write to or read from the state volume."""
    unwritten = "times the state volume could not be written"
    yield Loss(unwritten, state.failures, state.last_failure, cause="state_unwritten")
    yield Loss("unreadable files of the state volume that were renamed", state.set_aside, cause="state_unreadable")


def _of_traces(traces: EpisodeTraces) -> Iterator[Loss]:
    """Spans that were not exported."""
    yield Loss("spans dropped because too many are in flight", traces.tracing.dropped, cause="spans_dropped")
    yield Loss(
        "spans that could not be exported", traces.tracing.failed, f"by {traces.tracing.endpoint}", cause="spans_failed"
    )


def _of_actions(outcomes: Outcomes) -> Iterator[Loss]:
    """Losses that actions reported."""
    for lost in outcomes.lost():
        cause = "action_" + re.sub(r"[^a-z]+", "_", lost.what.lower()).strip("_")
        what = f"{lost.what} (action {lost.which.action} of EventRule {lost.which.rule})"
        yield Loss(what, lost.count, lost.last, cause=cause, rule=lost.which.rule)


def _unused(path: Path) -> Path:
    """The path, or an unused one beside it if the file exists: a restart must not overwrite a recording."""
    candidates = chain([path], (path.with_name(f"{path.stem}.{number}{path.suffix}") for number in count(2)))
    free = next(candidate for candidate in candidates if not candidate.exists())
    if free != path:
        _log.warning("%s already exists: recording into %s", path, free)
    return free


def _checked(detector: Detector) -> StreamReaders:
    """The inputs of its streams. Raises DetectorError, also if a plugin is missing or rejects its parameters."""
    readers = stream_readers(detector)
    problems = list(source_plugin_problems(detector))
    if problems:
        raise DetectorError(problems)
    return readers


def _subscribed(streams: Iterable[Stream]) -> list[tuple[object, ...]]:
    """The streams in the form that the network needs."""
    return [
        (stream.name, stream.key, stream.layout, stream.domain, stream.type, stream.history, stream.recover)
        for stream in streams
        if stream.source == ZENOH
    ]


class LoopMonitor:
    """Schedules a callback in the loop, and measures its delay."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._sent: float | None = None

    def silence(self) -> float:
        """Seconds for which the callback has been overdue; 0.0 if it is not. From any thread."""
        with self._lock:
            if self._sent is None:
                self._sent = time.monotonic()
                try:
                    self._loop.call_soon_threadsafe(self._answered)
                except RuntimeError:  # closed: the process is ending
                    self._sent = None
            return 0.0 if self._sent is None else time.monotonic() - self._sent

    def _answered(self) -> None:
        with self._lock:
            self._sent = None
