"""`detector run`: wires streams, evaluation, actions and rules together, and ends in good order on SIGTERM.

Zenoh ─▶ intake ─▶ evaluator (thread, owns the engine) ─▶ events: Zenoh, file
                      ▲                                └▶ demands: reconciler ─▶ tasks (API server, or files)
      rules: API server, or files                            Lease (in a cluster)
"""

from __future__ import annotations

import asyncio
import gc
import logging
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from detector.actions.deploy import DemandReconciler
from detector.actions.file_store import FileTaskStore, write_tasks_yaml
from detector.actions.kubernetes_store import KubernetesTaskStore
from detector.actions.lease import HolderLease
from detector.actions.stores import TaskStore, restore
from detector.assembly import DetectorError, inlets, make_engine
from detector.cluster.connection import connect
from detector.engine.demands import Demand
from detector.engine.intake import Intake
from detector.evaluator import Evaluator
from detector.event_log import EventLog
from detector.outlet import LiveOutlet
from detector.replay.intake_writer import IntakeWriter
from detector.rules.files import load_rules
from detector.rules.kubernetes import ClusterRules
from detector.rules.selection import RuleSet
from detector.streams.zenoh import Network
from wayside.api import Detector
from wayside.api.detector import Stream

_log = logging.getLogger(__name__)

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Files:
    """The Detector and its rules come from files; tasks go into files."""

    detector: Path
    rules: tuple[Path, ...]
    output: Path


@dataclass(frozen=True, slots=True)
class Named:
    """The Detector of that name and its rules come from the API server; tasks go there."""

    name: str
    namespace: str | None
    output: Path | None


@dataclass(frozen=True, slots=True)
class Options:
    """What to run."""

    source: Files | Named
    record_intake: Path | None = None


def _keys(streams: Iterable[Stream]) -> list[tuple[str, str]]:
    """What the network has to know of the streams."""
    return [(stream.name, stream.key) for stream in streams]


async def run(options: Options) -> None:
    """Run until SIGTERM or SIGINT.

    Raises:
        DocumentError, DetectorError, NetworkError, NoClusterError, OSError: it cannot start; the text says why.
    """
    _tune_garbage_collection()
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopping.set)
    match options.source:
        case Files() as files:
            await _run_from_files(files, options.record_intake, stopping)
        case Named() as named:
            await _run_in_cluster(named, options.record_intake, stopping)


def _tune_garbage_collection() -> None:
    """Let Python look for reference cycles less often.

    A sample is a tuple, and by default every 700 new ones start a search, although they never form cycles. That cost as
    much as receiving and inserting them (`benchmarks/intake_rate.py`).
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 50)


async def _run_from_files(files: Files, record: Path | None, stopping: asyncio.Event) -> None:
    loaded = load_rules(files.detector, files.rules)
    for warning in loaded.warnings:
        _log.warning("%s", warning)
    holder = loaded.rule_set.detector.name
    folder = files.output / "tasks"
    store = FileTaskStore(folder, holder)
    reconciler = DemandReconciler(store)
    restored = await restore(store)
    async with asyncio.TaskGroup() as group:
        group.create_task(reconciler.run())
        try:
            with _Running(loaded.rule_set, holder, reconciler, files.output, record, restored) as running:
                await running.until(stopping)
        finally:
            reconciler.stop()
    write_tasks_yaml(files.output / "tasks.yaml", (await store.all()).values())


async def _run_in_cluster(named: Named, record: Path | None, stopping: asyncio.Event) -> None:
    async with connect(named.namespace) as cluster:
        rules = ClusterRules(cluster.api, cluster.namespace, named.name)
        lease = HolderLease(cluster.api, cluster.namespace, named.name)
        store = KubernetesTaskStore(cluster.api, cluster.namespace, named.name)
        reconciler = DemandReconciler(store, permitted=lease.held)
        async with asyncio.TaskGroup() as group:
            group.create_task(lease.run())
            try:
                await _run_while_held(named, record, stopping, rules, lease, store, reconciler)
            finally:
                lease.stop()


async def _run_while_held(
    named: Named,
    record: Path | None,
    stopping: asyncio.Event,
    rules: ClusterRules,
    lease: HolderLease,
    store: TaskStore,
    reconciler: DemandReconciler,
) -> None:
    changes = rules.follow()
    first = await _unless(stopping, anext(changes))
    if first is None or await _unless(stopping, lease.held.wait()) is None:
        return
    restored = await _unless(stopping, restore(store))
    if restored is None:
        return
    async with asyncio.TaskGroup() as group:
        group.create_task(reconciler.run())
        try:
            with _Running(first, named.name, reconciler, named.output, record, restored) as running:
                following = group.create_task(running.follow(changes))
                await running.until(stopping)
                following.cancel()
        finally:
            reconciler.stop()


async def _unless(stopping: asyncio.Event, work: Awaitable[Result]) -> Result | None:
    """The work's result, or None if it is to stop before."""
    working = asyncio.ensure_future(work)
    ending = asyncio.ensure_future(stopping.wait())
    done, pending = await asyncio.wait({working, ending}, return_when=asyncio.FIRST_COMPLETED)
    for task in pending:
        task.cancel()
    await asyncio.gather(*pending, return_exceptions=True)
    return working.result() if working in done else None


def _unused(path: Path) -> Path:
    """The path, or where there is a file already, one beside it: a restart must not destroy what was recorded."""
    candidates = (path, *(path.with_name(f"{path.stem}.{number}{path.suffix}") for number in range(2, 1_000_000)))
    free = next(candidate for candidate in candidates if not candidate.exists())
    if free != path:
        _log.warning("%s exists already: recording into %s", path, free)
    return free


class _Running:
    """A detector at work: inside the `with`, its threads run."""

    def __init__(
        self,
        rule_set: RuleSet,
        holder: str,
        reconciler: DemandReconciler,
        output: Path | None,
        record: Path | None,
        restored: Sequence[Demand],
    ) -> None:
        """Raises DetectorError where the Detector cannot run, OSError where a file cannot be written."""
        self._loop = asyncio.get_running_loop()
        self._failed: asyncio.Future[None] = self._loop.create_future()
        self._rule_set = rule_set
        self._restored = restored
        detector = rule_set.detector
        entries = inlets(detector)
        self._intake = Intake(time.time_ns)
        self._engine = make_engine(detector, entries, holder=holder, start=time.time_ns())
        self._writer = None if record is None else IntakeWriter(_unused(record), detector.spec.streams)
        self._log = None if output is None else EventLog(output / "events.jsonl")
        self._outlet = LiveOutlet(self._network(detector), self._log, reconciler)
        self._reconciler = reconciler
        self._evaluator = Evaluator(
            self._engine,
            self._intake,
            self._outlet,
            now=time.time_ns,
            recorder=self._writer,
            on_failure=self._fail,
        )

    def __enter__(self) -> _Running:
        self._evaluator.start(self._rule_set, self._restored)
        self._outlet.network.start()
        _log.info(
            "Detector %s runs with %d rules and %d restored demands",
            self._rule_set.detector.name,
            len(self._engine.rules),
            len(self._restored),
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._evaluator.stop()
        self._outlet.network.close()
        if self._log is not None:
            self._log.close()
        if self._writer is not None:
            self._writer.close()
        self._summarise()

    async def until(self, stopping: asyncio.Event) -> None:
        """Wait for the end. Raises what ended the evaluation, if it was that."""
        async with asyncio.TaskGroup() as group:
            ending = group.create_task(stopping.wait())
            self._failed.add_done_callback(lambda _: ending.cancel())
        if self._failed.done():
            self._failed.result()

    async def follow(self, changes: AsyncIterator[RuleSet]) -> None:
        """Take over each change of the Detector and its rules."""
        async for wanted in changes:
            detector, before = self._good(wanted.detector), self._rule_set.detector.spec
            self._rule_set = replace(wanted, detector=detector)
            self._evaluator.configure(self._rule_set)
            spec = detector.spec
            if spec.zenoh != before.zenoh or _keys(spec.streams) != _keys(before.streams):
                await asyncio.to_thread(self._outlet.move, self._network(detector))

    def _network(self, detector: Detector) -> Network:
        spec = detector.spec
        return Network(spec.zenoh, spec.streams, self._intake.putter, on_failure=self._fail)

    def _good(self, wanted: Detector) -> Detector:
        """The changed Detector; the last one where it cannot run."""
        try:
            inlets(wanted)
        except DetectorError as error:
            _log.error("Detector %s is not followed, the last good one goes on: %s", wanted.name, error)
            return self._rule_set.detector
        return wanted

    def _fail(self, error: BaseException) -> None:
        def tell() -> None:
            if not self._failed.done():
                self._failed.set_exception(error)

        self._loop.call_soon_threadsafe(tell)

    def _summarise(self) -> None:
        self._evaluator.losses.sum_up()
        if self._outlet.network.dropped_events:
            _log.warning("in all, %d events not published", self._outlet.network.dropped_events)
