"""Sources are supervised: restarted when they fail, abandoned when they hang, changed while running."""

import asyncio
import itertools
import threading
from collections.abc import AsyncIterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

import pytest
from pydantic import BaseModel, ConfigDict

from detector.actions.deploy.file_store import FileTaskStore
from detector.actions.deploy.reconciler import DemandReconciler
from detector.assembly import DetectorError, stream_readers
from detector.engine.samples.intake import Intake
from detector.live.running import Running, RunOptions
from detector.live.state import RestoredState
from detector.plugins import entrypoints
from detector.resources.selection import RuleSet
from detector.sources import Feed, Source
from detector.sources.registry import OFFERS, source_plugin_problems
from detector.sources.supervision import Sources, SourceState, SourceThread
from detector.streams.loss_counter import Cause, LossCounter
from tests.driving import a_detector, a_stream
from tests.networks import Arrivals, stream, wait_for
from tests.patience import PATIENCE
from wayside.api import Detector
from wayside.api.plugin import DataSource


class NoParameters(BaseModel):
    model_config = ConfigDict(extra="forbid")
    text: str = "once"


class Once(Source[NoParameters]):
    """Delivers one message and returns."""

    Parameters: ClassVar[type[BaseModel]] = NoParameters

    def run(self, feed: Feed) -> None:
        feed.put("vehicles/car1/pose", self.parameters.text.encode())
        feed.put("vehicles/car1/other", b"no stream's")


class Failing(Once):
    """Delivers one message, then fails."""

    def run(self, feed: Feed) -> None:
        super().run(feed)
        raise RuntimeError("the cable is out")


class Leaving(Once):
    """Tries to end the whole program."""

    def run(self, feed: Feed) -> None:
        raise SystemExit(3)


class Lasting(Once):
    """Delivers one message and waits for its end."""

    def run(self, feed: Feed) -> None:
        super().run(feed)
        while not feed.wait(10):
            pass


class Hanging(Once):
    """Ignores the feed."""

    began, ended = threading.Event(), threading.Event()

    def run(self, feed: Feed) -> None:
        self.began.set()
        self.ended.wait(PATIENCE)
        feed.put("vehicles/car1/pose", b"late")


class WithoutModel(Source[Any]):
    """Has no model for its parameters."""

    def run(self, feed: Feed) -> None: ...


@pytest.fixture(autouse=True)
def plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """The classes above as installed plugins."""
    here = [
        EntryPoint(each.lower(), f"{__name__}:{each}", OFFERS.group)
        for each in ("Once", "Failing", "Leaving", "Lasting", "Hanging", "WithoutModel", "NoParameters", "Absent")
    ]
    here.append(EntryPoint("unmet", "no_such_module:Plugin", OFFERS.group))
    monkeypatch.setattr(entrypoints, "entry_points", lambda group: here)
    entrypoints._load.cache_clear()


def a_thread(plugin: str, arrivals: Arrivals, loss_counter: LossCounter) -> SourceThread:
    source = DataSource(name="s", plugin=plugin)
    thread = SourceThread(source, (stream(source="s"),), arrivals.putter, loss_counter, first_pause=0.01)
    thread.start()
    return thread


def a_detector_of(*sources: dict[str, Any], **stream: Any) -> Detector:
    streams = (
        a_stream(f"stream{index}", key="vehicles/${client:*}/pose", source=each["name"], **stream)
        for index, each in enumerate(sources)
    )
    return a_detector(*streams, sources=list(sources))


def test_a_message_that_belongs_to_several_streams_reaches_them_at_one_time() -> None:
    times = itertools.count(100)
    intake = Intake(lambda: next(times))
    streams = (
        stream(source="s"),
        stream("rest", "vehicles/**/${client:*}/other"),
        stream("all", "**/${client:*}/pose"),
    )
    feed = Feed(streams, intake.putter, lambda key: None)
    feed.put("vehicles/car1/pose", b"1")
    feed.put("vehicles/car1/pose", b"2")
    assert [(each.received, each.stream, each.payload) for each in intake.drain(0)] == [
        (100, "pose", b"1"),
        (100, "all", b"1"),
        (101, "pose", b"2"),
        (101, "all", b"2"),
    ]
    assert feed.messages == 2


def test_messages_reach_their_streams_and_others_are_counted(arrivals: Arrivals) -> None:
    loss_counter = LossCounter()
    thread = a_thread("once", arrivals, loss_counter)
    wait_for(lambda: thread.state is SourceState.FINISHED)
    assert arrivals.seen == [("pose", "vehicles/car1/pose", b"once")]
    assert thread.messages == 1
    assert [(e.cause, e.name, e.count, e.last) for e in loss_counter.entries()] == [
        (Cause.UNROUTED, "s", 1, "vehicles/car1/other")
    ]


@pytest.mark.parametrize(
    ("plugin", "error"), [("failing", "RuntimeError: the cable is out"), ("leaving", "SystemExit: 3")]
)
def test_a_failing_source_is_restarted_and_counted(plugin: str, error: str, arrivals: Arrivals) -> None:
    loss_counter = LossCounter()
    thread = a_thread(plugin, arrivals, loss_counter)

    def failures() -> int:
        return sum(entry.count for entry in loss_counter.entries() if entry.cause is Cause.FAILED)

    wait_for(lambda: failures() >= 3)
    thread.request_stop()
    thread.join(PATIENCE)
    assert thread.state is SourceState.STOPPED
    assert thread.last_error == error
    assert len(arrivals.seen) in ((0,) if plugin == "leaving" else (failures(), failures() + 1))


def test_a_hanging_source_is_abandoned_and_its_late_messages_are_dropped(arrivals: Arrivals) -> None:
    loss_counter = LossCounter()
    Hanging.began.clear()
    Hanging.ended.clear()
    thread = a_thread("hanging", arrivals, loss_counter)
    assert Hanging.began.wait(PATIENCE)  # a source that is stopped before it runs ends
    thread.request_stop()
    thread.join(0.05)
    assert [(entry.cause, entry.count) for entry in loss_counter.entries()] == [(Cause.LEFT_BEHIND, 1)]
    Hanging.ended.set()
    wait_for(lambda: thread.state is SourceState.STOPPED)
    assert arrivals.seen == []


def test_unchanged_sources_continue_while_others_change(arrivals: Arrivals) -> None:
    sources = Sources(arrivals.putter, LossCounter())
    first = {"name": "first", "plugin": "lasting"}
    second = {"name": "second", "plugin": "lasting"}
    sources.follow(a_detector_of(first, second))
    kept, changed = sources.threads
    sources.follow(a_detector_of(first, {**second, "parameters": {"text": "new"}}))
    assert sources.threads[0] is kept
    sources.follow(a_detector_of(first, {**second, "parameters": {"text": "new"}}, buffer={"duration": "1m"}))
    assert sources.threads[0] is kept
    wait_for(lambda: changed.state is SourceState.STOPPED)
    arrivals.wait_for(lambda seen: [payload for _, _, payload in seen].count(b"new") == 1)
    sources.follow(a_detector())
    wait_for(lambda: kept.state is SourceState.STOPPED)
    assert not sources.threads
    sources.close()


def test_a_running_detector_follows_changes_of_its_sources_and_reports_their_state(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = ({"name": name, "plugin": "lasting"} for name in ("first", "second"))
    unknown = {"name": "first", "plugin": "unknown"}

    async def changes() -> AsyncIterator[RuleSet]:
        for sources in ([first, second], [unknown]):
            yield RuleSet(a_detector_of(*sources), ())

    def states(running: Running) -> list[tuple[str, str, int]]:
        return [(each.name, each.state, each.messages) for each in running.answers.status().sources]

    async def live() -> None:
        reconciler = DemandReconciler(FileTaskStore(tmp_path, "h"))
        with Running(RuleSet(a_detector_of(first), ()), "h", reconciler, RestoredState(), RunOptions()) as running:
            await asyncio.to_thread(wait_for, lambda: states(running) == [("first", "Running", 1)])
            await running.follow(changes())
            await asyncio.to_thread(
                wait_for, lambda: states(running) == [("first", "Running", 1), ("second", "Running", 1)]
            )

    asyncio.run(live())
    assert "keeping the last good one: spec.sources[0].plugin: no plugin unknown" in caplog.text


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ({"plugin": "onec"}, "spec.sources[0].plugin: no plugin onec is installed; did you mean once?"),
        (
            {"plugin": "unmet"},
            "spec.sources[0].plugin: cannot load plugin unmet: ModuleNotFoundError: No module named",
        ),
        ({"plugin": "absent"}, "spec.sources[0].plugin: cannot load plugin absent: AttributeError"),
        ({"plugin": "noparameters"}, "must be a complete subclass of detector.sources.base.Source"),
        (
            {"plugin": "withoutmodel"},
            "spec.sources[0].plugin: plugin withoutmodel: give tests.process.test_sources:WithoutModel a",
        ),
        (
            {"plugin": "once", "parameters": {"text": 1}},
            "spec.sources[0].parameters.text: must be a string; got 1: put it in quotes",
        ),
        ({"plugin": "once", "parameters": {"txt": "a"}}, "spec.sources[0].parameters.txt: unknown field"),
    ],
)
def test_errors_of_a_source_are_reported_by_field(source: dict[str, Any], problem: str) -> None:
    found = [str(each) for each in source_plugin_problems(a_detector_of({"name": "s", **source}))]
    assert len(found) == 1
    assert problem in found[0]


def test_streams_and_sources_must_fit_together() -> None:
    detector = a_detector(
        a_stream("pose", source="brokr"),
        sources=[{"name": "broker", "plugin": "once"}, {"name": "zenoh", "plugin": "once"}],
    )
    with pytest.raises(DetectorError) as caught:
        stream_readers(detector)
    assert [str(problem) for problem in caught.value.problems] == [
        "spec.sources[0].name: no stream uses broker: set source: broker in a stream, or remove it",
        "spec.sources[1].name: zenoh is the session of spec.zenoh, which always exists: choose another name",
        "spec.streams[0].source: Detector d has no source brokr; did you mean broker?",
    ]
