"""`detector run`: connects streams, evaluation, actions and rules, and stops cleanly on SIGTERM.

Zenoh ─▶ intake ─▶ evaluator (thread, owns the engine) ─▶ events: Zenoh, file
                      ▲                                └▶ demands: reconciler ─▶ tasks (API server, or files)
      rules: API server, or files                            Lease (in a cluster)
"""

from __future__ import annotations

import asyncio
import logging
import signal
from dataclasses import dataclass
from pathlib import Path

from detector.actions.deploy.file_store import FileTaskStore, write_tasks_yaml
from detector.actions.deploy.reconciler import DemandReconciler
from detector.actions.tracing import EpisodeTraces, episode_traces
from detector.assembly import detector_problems
from detector.assembly.memory import tune_garbage_collection
from detector.live.running import Running, RunOptions
from detector.live.state import state_file, what_was_open
from detector.resources.files import follow_files, hangups, load_rules

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FromFiles:
    """The Detector and its rules come from files; tasks go into the folder `tasks` of the output."""

    detector: Path
    rules: tuple[Path, ...]
    output: Path


@dataclass(frozen=True, slots=True)
class FromCluster:
    """The Detector of that name and its rules come from the API server; tasks go there."""

    name: str
    namespace: str | None
    holder: str
    """The holder of the tasks: the name of the Detector, or `<name>.<pod>` if several pods run it."""


async def run_detector(source: FromFiles | FromCluster, options: RunOptions) -> None:
    """Run until SIGTERM or SIGINT.

    Raises:
        DocumentError, DetectorError, NetworkError, ConfigurationError, OSError: it cannot start; the message gives the
        reason.
    """
    tune_garbage_collection()
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopping.set)
    with episode_traces() as traces:
        match source:
            case FromFiles() as files:
                await _run_from_files(files, options, stopping, traces)
            case FromCluster() as named:
                # Not at the top: the Kubernetes client takes half a second to import, and only a cluster needs it.
                from detector.live.in_cluster import run_in_cluster  # noqa: PLC0415

                await run_in_cluster(named.name, named.namespace, named.holder, options, stopping, traces)


async def _run_from_files(
    files: FromFiles, options: RunOptions, stopping: asyncio.Event, traces: EpisodeTraces | None
) -> None:
    changed = hangups()
    loaded = load_rules(files.detector, files.rules, detector_problems)
    for warning in loaded.warnings:
        _log.warning("%s", warning)
    holder = loaded.rule_set.detector.name
    store = FileTaskStore(files.output / "tasks", holder)
    reconciler = DemandReconciler(store, traces=traces)
    state = state_file(loaded.rule_set.detector, holder)
    restored = await what_was_open(store, state)
    running = Running(loaded.rule_set, holder, reconciler, restored, options, state=state, traces=traces)
    await running.run(follow_files(files.detector, files.rules, detector_problems, changed), stopping)
    write_tasks_yaml(files.output / "tasks.yaml", (await store.all()).values())
