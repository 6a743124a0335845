"""An engine on its own thread, with a clock that the test sets: its input and its events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from detector.assembly import make_engine, stream_readers
from detector.engine.episodes.events import Event
from detector.engine.samples.intake import Intake
from detector.engine.samples.sample import Arrival
from detector.live.evaluator import Evaluator
from detector.live.state import RestoredState
from detector.replay.intake_file import Control
from detector.resources.selection import RuleSet
from tests.driving import START
from wayside.api import Detector


class Recording:
    """Keeps the input and output of a live engine: recorder and event sink in one."""

    def __init__(self) -> None:
        self.records: list[Arrival | Control] = []
        self.logged: list[Event] = []

    def arrivals(self, arrivals: Sequence[Arrival]) -> None:
        self.records += arrivals

    def follow(self, *_: Any) -> None: ...

    def consequences(self, *_: Any) -> None: ...

    def open_episodes(self, *_: Any) -> None: ...

    def demands(self, *_: Any) -> None: ...

    def control(self, time: int, document: Mapping[str, Any]) -> None:
        self.records.append(Control(time, dict(document)))

    def events(self, events: Sequence[Event]) -> None:
        self.logged += events


class Live:
    """The engine of a detector with these rules, at work until `stop`."""

    def __init__(self, detector: Detector, rules: Sequence[Any]) -> None:
        self.now = START
        self.recording = Recording()
        self._failures: list[BaseException] = []
        self.engine = make_engine(detector, stream_readers(detector), holder="d", start=START)
        intake = self.intake = Intake(lambda: self.now)
        self.evaluator = Evaluator(
            self.engine,
            intake,
            self.recording,
            now=lambda: self.now,
            recorder=self.recording,
            on_failure=self._failures.append,
        )
        self.put = intake.putter("speed")
        self.evaluator.start(RuleSet(detector, tuple(rules)), RestoredState())

    def stop(self) -> Recording:
        self.evaluator.stop()
        assert self._failures == []
        return self.recording
