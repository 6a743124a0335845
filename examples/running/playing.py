"""Plays a recording to the detector's engine, and lets the rules' actions do their work.

`detector replay` runs the same engine, and of the actions only deploy. Here all run as in a live detector, each on its
thread; what they would publish over Zenoh is collected, and what they record goes below a folder.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain, groupby
from pathlib import Path
from threading import Lock
from typing import Any

from detector.actions.base import ActionError, DetectorConfiguration
from detector.actions.episode import Outcome as ActionOutcome
from detector.actions.episode import OutcomeState
from detector.actions.host import ActionHost
from detector.actions.outcomes import ActionKey
from detector.assembly import stream_readers
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from detector.replay.playing import recorded_arrivals
from detector.replay.recorded_types import with_recorded_types
from detector.replay.replaying import Replay, ReplayResult
from detector.replay.routing import MessageRouter
from detector.resources.files import load_rules
from detector.testing import RefusedError
from examples.running.scenario import START_NS
from wayside.api import ApplicationTask, Detector

RECORDINGS = "recordings"
"""Below the output: the folder of what record actions write."""
_STEP = 50_000_000
"""Nanoseconds between two looks at the intake, as the live detector has them."""
_PATIENCE = 60.0
"""Seconds that the actions have to end their work."""


@dataclass(frozen=True, slots=True)
class Notice:
    """A message that an action published."""

    key: str
    content: Any


@dataclass(slots=True)
class Played:
    """The results of a played scenario."""

    folder: Path
    """The folder of the recordings."""
    events: list[Event] = field(default_factory=list)
    tasks: list[ApplicationTask] = field(default_factory=list)
    """The last states of the tasks, ordered by name."""
    history: list[tuple[float, ApplicationTask]] = field(default_factory=list)
    """Each version of each task, with the second at which it was there; parameters may follow what happens."""
    outcomes: list[tuple[ActionKey, ActionOutcome]] = field(default_factory=list)
    """The outcome of each episode at each action except deploy."""
    notices: list[Notice] = field(default_factory=list)
    samples: int = 0

    def done(self) -> Counter[str]:
        """The number of outcomes or tasks of each `<rule>/<action>`."""
        done = Counter(f"{which.rule}/{which.action}" for which, each in self.outcomes if _is_done(each))
        for task in self.tasks:
            if task.spec.event is not None:
                done[f"{task.spec.event.rule}/{task.spec.event.action}"] += 1
        return done

    def failures(self) -> list[str]:
        """The failures of actions, a line each."""
        return [f"{which.rule}/{which.action}: {each.message}" for which, each in self.outcomes if not _is_done(each)]

    def recordings(self, rule: str) -> list[Path]:
        """The folders of the rule's recordings, in the order of their starts."""
        return sorted(
            Path(str(each.details["folder"])) for which, each in self.outcomes
            if which.rule == rule and "folder" in each.details
        )  # fmt: skip


def play(folder: Path, recording: Path, output: Path) -> Played:
    """Play a recording to the detector and the rules of a use case's folder.

    Args:
        folder: with `detector.yaml` and `rules.yaml`.
        recording: an MCAP file.
        output: recordings and the like go below it.

    Raises:
        RefusedError, DocumentError, DetectorError, RecordingError: a file cannot be used.
    """
    loaded = load_rules(folder / "detector.yaml", [folder / "rules.yaml"])
    if loaded.warnings:
        raise RefusedError("; ".join(loaded.warnings))
    detector = _at(with_recorded_types(loaded.rule_set.detector, [recording]), output)
    arrivals = chain.from_iterable(recorded_arrivals([recording], MessageRouter(detector.spec.streams), detector))
    wire, outcome = _Wire(), ReplayResult()
    host = ActionHost(detector.name, wire)
    played = Played(output)
    versions: dict[str, ApplicationTask] = {}
    lock = Lock()

    def note(engine: Engine) -> None:
        """Pass on what happened, and keep the tasks' new versions."""
        host.dispatch(engine.consequences.drain(engine.now))
        for name, task in outcome.tasks.items():
            if versions.get(name) is not task:
                versions[name] = task
                played.history.append((seconds(engine.now), task))

    def heard(which: ActionKey, episode: str, logged: ActionOutcome) -> None:
        if logged.state is not OutcomeState.RUNNING:
            with lock:
                played.outcomes.append((which, logged))

    host.outcomes.on_outcome = heard
    entries = stream_readers(detector)
    replay: Replay | None = None
    try:
        for batch in _batches(arrivals):
            if replay is None:
                start = batch[0].received - 1
                replay = Replay(detector, [], holder=detector.name, start=start, outcome=outcome)
                replay.engine.consequences.wanted = True
                replay.set_rules(loaded.rule_set.rules)
                if outcome.refusals:
                    raise RefusedError("; ".join(map(str, outcome.refusals)))
                host.follow(loaded.rule_set.rules, DetectorConfiguration(detector, entries.decoders, entries.types))
            # A tick at the very time of the last sample must wait for what else was received before its end.
            replay.advance(batch, batch[-1].received - 1)
            note(replay.engine)
        if replay is not None:
            replay.advance((), batch[-1].received)
            note(replay.engine)
            host.dispatch(replay.engine.consequences.cut(replay.engine.now, "the recording ends"))
        _wait(host)
    finally:
        host.close()
    played.events, played.samples, played.notices = outcome.events, outcome.samples, wire.notices
    played.tasks = [outcome.tasks[name] for name in sorted(outcome.tasks)]
    return played


def seconds(time_ns: int) -> float:
    """A time in nanoseconds since the epoch as seconds into the scenario."""
    return (time_ns - START_NS) / 1e9


def _at(detector: Detector, output: Path) -> Detector:
    """The Detector with its folders below the output."""
    spec = detector.spec
    if spec.recordings is None:
        return detector
    recordings = spec.recordings.model_copy(
        update={"path": str(output / RECORDINGS), "reserve": type(spec.recordings.reserve)("0")}
    )
    return detector.model_copy(update={"spec": spec.model_copy(update={"recordings": recordings})})


def _batches(arrivals: Iterable[Arrival]) -> Iterator[list[Arrival]]:
    for _, batch in groupby(arrivals, key=lambda each: each.received // _STEP):
        yield list(batch)


def _wait(host: ActionHost) -> None:
    """Until all actions have ended their work."""
    deadline = time.monotonic() + _PATIENCE
    while any(counts.running for counts in host.outcomes.counts_by_action().values()) and time.monotonic() < deadline:
        time.sleep(0.005)


def _is_done(outcome: ActionOutcome) -> bool:
    return outcome.state is OutcomeState.DONE


class _Wire:
    """In place of the network: keeps what is published, and nobody answers."""

    def __init__(self) -> None:
        self.notices: list[Notice] = []

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        if not key.startswith("wayside/"):  # the detector's own messages
            self.notices.append(Notice(key, json.loads(payload)))

    def query(
        self, selector: str, payload: bytes | None, timeout: float, attachment: bytes | None = None
    ) -> list[bytes]:
        raise ActionError(f"nobody answers {selector}: the examples run without a network")
