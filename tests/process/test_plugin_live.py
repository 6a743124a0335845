"""A plugin in a running detector is killed and restarted; the replay gives the same events."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from detector.actions.base import DetectorConfiguration
from detector.assembly import make_engine, stream_readers
from detector.engine.consequences import Consequence
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import OpenEpisode
from detector.engine.samples.intake import Intake
from detector.live.evaluator import Evaluator
from detector.live.state import RestoredState
from detector.plugins.outages import Outages
from detector.plugins.processes import ProcessHost
from detector.replay.intake_file import read_intake, recorded_outages
from detector.replay.intake_writer import IntakeWriter
from detector.replay.replaying import replay_intake
from detector.resources.selection import RuleSet
from tests.driving import a_detector
from tests.patience import PATIENCE
from tests.plugins.rules import plugin_rule, plugins
from wayside.api import EventRule

__all__ = ["plugins"]  # a fixture

OFTEN = {"every": "50ms"}
RULE = plugin_rule(when="p.count - 6 * double(int(p.count / 6)) >= 3", evaluation=OFTEN, unknownTimeout="100ms")
OTHER = plugin_rule("other", when="p.count - 4 * double(int(p.count / 4)) >= 2", evaluation=OFTEN)


class CollectingSink:
    """Collects events and discards everything else."""

    def __init__(self) -> None:
        self.all: list[Event] = []

    def events(self, events: Sequence[Event]) -> None:
        self.all += events

    def follow(self, rules: Sequence[EventRule], configuration: DetectorConfiguration) -> None:
        pass

    def consequences(self, consequences: Sequence[Consequence]) -> None:
        pass

    def open_episodes(self, episodes: Callable[[], Sequence[OpenEpisode]]) -> None:
        pass

    def demands(self, demands: Mapping[str, Demand], ended: Mapping[str, int]) -> None:
        pass


def wait_until(condition: Callable[[], bool], feed: Callable[[], None]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        feed()
        assert time.monotonic() < deadline
        time.sleep(0.02)  # the pace of the samples


@pytest.mark.usefixtures("plugins")
def test_killed_and_started_again_the_replay_gives_the_same_events(tmp_path: Path) -> None:
    detector = a_detector()
    failures: list[BaseException] = []
    kept, intake = CollectingSink(), Intake(time.time_ns)
    writer = IntakeWriter(tmp_path / "intake.mcap", detector.spec.streams)
    with closing(ProcessHost(patience=PATIENCE)) as host:
        engine = make_engine(detector, stream_readers(detector), holder="h", start=time.time_ns(), plugins=host)
        evaluator = Evaluator(
            engine,
            intake,
            kept,
            now=time.time_ns,
            recorder=writer,
            on_failure=failures.append,
            outages=host.outages,
        )
        evaluator.start(RuleSet(detector, (RULE, OTHER)), RestoredState())
        put = intake.putter("speed")

        def feed() -> None:
            put([("vehicles/a/speed", b'{"v": 1}')])

        def started(rule: str) -> int:
            return sum(event.episode.rule == rule and event.started for event in kept.all)

        wait_until(lambda: started("r") >= 1 and started("other") >= 1, feed)
        process = host._signals["r", "p"]._process
        assert process is not None
        os.kill(process.pid, signal.SIGKILL)
        before, others = started("r"), started("other")
        wait_until(lambda: started("r") > before + 1 and started("other") > others + 1, feed)
        evaluator.stop()
    writer.close()
    assert not failures
    assert len([*recorded_outages(tmp_path / "intake.mcap")]) >= 4
    with closing(ProcessHost(Outages(lambda: recorded_outages(tmp_path / "intake.mcap")), wait=True)) as again:
        again._patience = PATIENCE
        outcome = replay_intake(read_intake(tmp_path / "intake.mcap"), None, None, again)
    assert [event.to_json() for event in outcome.events] == [event.to_json() for event in kept.all]
