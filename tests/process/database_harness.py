"""Runs a database action as its host does, against a real server: short episodes and their outcomes."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from detector.actions import (
    ActionContext,
    Completion,
    DetectorConfiguration,
    Episode,
    EpisodeSample,
    Outcome,
    OutcomeState,
)
from detector.actions.database import Database
from detector.assembly import stream_readers
from tests.driving import START, a_detector, a_rule, a_stream, at
from tests.patience import PATIENCE
from wayside.api.actions.database import DatabaseAction

SPEEDS = "json/speed"
"""The collection of the samples of stream speed."""


class NoMessenger:
    """A messenger without Zenoh, which the action does not need."""

    def publish(self, *_: Any) -> None:
        raise AssertionError("the database action publishes nothing")

    def query(self, *_: Any) -> list[bytes]:
        raise AssertionError("the database action sends no queries")


class Harness:
    """One action, driven step by step."""

    def __init__(self, database: dict[str, Any], name: str, streams: Sequence[Any] = (), **parameters: Any) -> None:
        self.detector = a_detector(*(streams or (a_stream("speed"), a_stream("pose"))), database=database)
        self.rule = a_rule("brake", when="true", description="Hard braking.", signals=[], actions=[])
        self.outcomes: dict[str, list[Outcome]] = {}
        self.losses: Counter[str] = Counter()
        self._changed = threading.Condition()
        readers = stream_readers(self.detector)
        self.configuration = DetectorConfiguration(self.detector, readers.decoders, readers.types)
        self.closing = threading.Event()
        context = ActionContext(
            rule=self.rule,
            action="keep",
            holder="d",
            configuration=lambda: self.configuration,
            messenger=NoMessenger(),
            report=self._report,
            lose=self._lose,
            closing=self.closing,
        )
        self.name = name
        self.action = Database(DatabaseAction(database=name, **parameters), context)
        self.action.wake()

    def _report(self, episode: Episode, outcome: Outcome) -> None:
        with self._changed:
            self.outcomes.setdefault(episode.id, []).append(outcome)
            self._changed.notify_all()

    def _lose(self, what: str, count: int, why: str) -> None:
        with self._changed:
            self.losses[f"{what}: {why}"] += count
            self._changed.notify_all()

    def begin(self, name: str = "e1", **fields: Any) -> Episode:
        known: dict[str, Any] = {
            "id": name,
            "rule": self.rule.name,
            "subject": "car1",
            "clients": ("car1",),
            "element": None,
            "onset_time": START,
            "start_time": START,
            "values": {"speed": 12.5},
            "classification": {"incidence": ["Rare"]},
            "rendered": {},
            "unrendered": {},
            "started": {},
        }
        episode = Episode(**{**known, **fields})
        self.action.started(episode)
        return episode

    def take(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        self.action.samples(episode, samples)
        self.action.wake()

    def finish(self, episode: Episode, cut: str = "", missing: int = 0) -> None:
        ended = replace(episode, end_time=at(60), reason="Until")
        self.action.ended(ended)
        self.action.completed(ended, Completion(cut, missing))

    def last(self, name: str = "e1") -> Outcome | None:
        with self._changed:
            return self.outcomes[name][-1] if name in self.outcomes else None

    def outcome(self, name: str = "e1", within: float = PATIENCE) -> Outcome:
        """The final outcome of the episode."""

        def final() -> bool:
            return name in self.outcomes and self.outcomes[name][-1].state is not OutcomeState.RUNNING

        with self._changed:
            assert self._changed.wait_for(final, within), self.outcomes.get(name)
            return self.outcomes[name][-1]

    def close(self) -> None:
        self.closing.set()
        self.action.close()


MakeHarness = Callable[..., Harness]
"""The fixture `harness`: creates a harness and closes it at the end of the test."""


def numbers(database: Any, scenario: str = "e1.keep", collection: str = SPEEDS) -> list[float]:
    return [each["msg"]["v"] for each in database[collection].find({"scenario": scenario}, sort=[("_id", 1)])]


def scenario(database: Any, name: str = "e1.keep") -> dict[str, Any]:
    found = database["Scenarios"].find_one({"_id": name})
    assert found is not None
    return dict(found)


def scenario_or_none(database: Any, name: str) -> dict[str, Any]:
    return database["Scenarios"].find_one({"_id": name}) or {}


def speeds(count: int, client: str = "car1", first: int = 0, pad: int = 0) -> list[EpisodeSample]:
    """`count` JSON samples, at 100 Hz."""
    filler = b', "pad": "' + b"x" * pad + b'"' if pad else b""
    return [
        EpisodeSample(client, "speed", f"vehicles/{client}/speed", time, time, b'{"v": %d%b}' % (number, filler))
        for number in range(first, first + count)
        for time in (START + number * 10_000_000,)
    ]


def wait_until(condition: Callable[[], bool], within: float = PATIENCE, pause: float = 0.02) -> None:
    deadline = time.monotonic() + within
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(pause)


def spooled(folder: Path) -> int:
    """Bytes in the file of a spool."""
    return (folder / "spool.db").stat().st_size
