"""Each action runs on its own thread, and its failures affect no other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import EntryPoint
from typing import Any, ClassVar

import pytest

from detector.actions import (
    Action,
    ActionError,
    ActionParameters,
    Completion,
    DetectorConfiguration,
    Episode,
    EpisodeSample,
    Outcome,
    OutcomeState,
    registry,
)
from detector.actions.host import ActionHost
from detector.actions.outcomes import ActionCounts, ActionKey
from detector.actions.worker import SILENT
from detector.assembly import stream_readers
from detector.engine.engine import Engine
from tests.driving import a_detector, a_rule, a_stream, an_engine, arrival, at, compiled
from tests.patience import PATIENCE
from wayside.api import EventRule

DETECTOR = a_detector(a_stream("speed"), clientTimeout="60s")
SLOW = threading.Event()
"""Set: the actions that wait for it continue."""


class Recorded(Action[ActionParameters]):
    """Records its calls."""

    Parameters = ActionParameters
    reported: ClassVar[list[str]] = []
    after: ClassVar[Callable[[str, Episode], None]] = staticmethod(lambda what, episode: None)

    def note(self, what: str, episode: Episode) -> None:
        self.reported.append(f"{self.context.action} {what} {episode.subject}")
        type(self).after(what, episode)

    def started(self, episode: Episode) -> None:
        self.note("started", episode)

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        self.note(f"{len(samples)} samples", episode)

    def ended(self, episode: Episode) -> None:
        assert episode.end_time is not None
        self.note(f"ended {episode.reason}", episode)

    def completed(self, episode: Episode, completion: Completion) -> None:
        self.note(f"completed {completion.cut or 'in time'}", episode)
        self.context.report(episode, Outcome(OutcomeState.DONE, missing=completion.missing))

    def close(self) -> None:
        self.reported.append(f"{self.context.action} closed")


class Raises(Recorded):
    """Raises for episodes of car1."""

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        if episode.subject == "car1":
            raise ActionError("the ink is dry")
        super().samples(episode, samples)


class Impossible(Recorded):
    """Raises in its constructor."""

    def __init__(self, *_: Any) -> None:
        raise OSError("no paper")


class Hangs(Recorded):
    """Blocks until it is released."""

    def started(self, episode: Episode) -> None:
        SLOW.wait(PATIENCE)
        super().started(episode)


class Silent(Recorded):
    """Never reports the outcome of its work."""

    def completed(self, episode: Episode, completion: Completion) -> None:
        self.note("completed", episode)


class Wakes(Recorded):
    """Requests wake-ups, and raises in one of them."""

    calls = 0

    def wake(self) -> float | None:
        type(self).calls += 1
        if type(self).calls == 1:
            raise ValueError("not yet awake")
        return 0.01


KINDS = {
    "recorded": Recorded,
    "raises": Raises,
    "impossible": Impossible,
    "hangs": Hangs,
    "wakes": Wakes,
    "silent": Silent,
}


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    entries = [EntryPoint(name, f"{__name__}:{kind.__name__}", "wayside.actions") for name, kind in KINDS.items()]
    monkeypatch.setattr("detector.plugins.entrypoints.entry_points", lambda group: entries)
    Recorded.reported.clear()
    SLOW.clear()
    before = threading.enumerate()
    yield
    SLOW.set()
    # A thread that has just been released must not write into the notes of the next test.
    for thread in set(threading.enumerate()).difference(before):
        thread.join(PATIENCE)


class HostHarness:
    """An engine and a host, and what was published."""

    def __init__(self, *rules: EventRule, **options: Any) -> None:
        self.engine: Engine = an_engine(DETECTOR)
        self.engine.consequences.wanted = True
        self.published: list[tuple[str, bytes]] = []
        self.host = ActionHost("h", self, now=lambda: 0, **options)
        self.follow(*rules)

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        self.published.append((key, payload))

    def query(self, *_: Any) -> list[bytes]:
        raise ActionError("nobody")

    def follow(self, *rules: EventRule) -> None:
        readers = stream_readers(DETECTOR)
        self.host.follow(rules, DetectorConfiguration(DETECTOR, readers.decoders, readers.types))
        self.engine.set_rules(compiled(DETECTOR, *rules))
        self.host.dispatch(self.engine.consequences.drain(self.engine.now))

    def take(self, *speeds: tuple[float, str, float], until: float) -> None:
        self.engine.advance([arrival(seconds, client, {"v": v}) for seconds, client, v in speeds], at(until))
        self.host.dispatch(self.engine.consequences.drain(self.engine.now))

    def counts(self, action: str) -> ActionCounts:
        return self.host.outcomes.counts_by_action()[ActionKey("fast", action)]

    def when(self, true: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < end, (
                Recorded.reported,
                self.host.outcomes.counts_by_action(),
                self.host.outcomes.lost(),
            )
            time.sleep(0.005)


def fast(**actions: str) -> EventRule:
    return a_rule(
        "fast",
        signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
        when="v > 0.5",
        evaluation={"every": "100ms"},
        actions=[
            {"name": name, "plugin": {"name": kind, "window": {"before": "1s"}}} for name, kind in actions.items()
        ],
    )


def one_episode(site: HostHarness, client: str = "car1", begin: float = 0.0) -> None:
    site.take((begin + 0.05, client, 1.0), until=begin + 0.5)
    site.take((begin + 0.55, client, 0.0), until=begin + 1.0)


def test_an_action_receives_an_episode_in_order_and_closed_at_last() -> None:
    site = HostHarness(fast(a="recorded"))
    one_episode(site)
    site.host.close()
    assert Recorded.reported == [
        "a started car1",
        "a 1 samples car1",
        "a ended Until car1",
        "a 1 samples car1",
        "a completed in time car1",
        "a closed",
    ]
    assert site.counts("a").done == 1


def test_an_exception_in_an_action_fails_only_its_episode() -> None:
    site = HostHarness(fast(a="raises", b="recorded"))
    one_episode(site)
    one_episode(site, "car2", begin=2.0)
    site.host.close()
    counts = site.counts("a")
    assert (counts.done, counts.failed, counts.running, counts.last_failure) == (
        1,
        1,
        0,
        "the ink is dry",
    )
    assert site.counts("b").done == 2
    assert [text for text in Recorded.reported if text.startswith("a") and "car1" in text] == ["a started car1"]


def test_an_action_that_cannot_be_created_fails_its_episodes_with_the_reason() -> None:
    site = HostHarness(fast(a="impossible", b="recorded"))
    one_episode(site)
    site.host.close()
    assert site.counts("a").last_failure == "cannot create the action: OSError: no paper"
    assert site.counts("b").done == 1


def test_a_hanging_action_delays_no_other_and_drops_beyond_its_queue_are_counted() -> None:
    site = HostHarness(fast(a="hangs", b="recorded"), maximum_bytes=1000)
    site.take((0.05, "car1", 1.0), until=0.5)
    for step in range(40):
        site.take((0.6 + step / 10, "car1", 1.0), until=0.65 + step / 10)
    site.take((5.0, "car1", 0.0), until=5.5)
    site.when(lambda: site.counts("b").done == 1 and site.counts("a").running == 1)
    SLOW.set()
    site.when(lambda: site.counts("a").done == 1)
    [lost] = [each for each in site.host.outcomes.lost() if each.which.action == "a"]
    assert lost.what == "samples left out because the action is too slow"
    counted = sum(int(text.split()[1]) for text in Recorded.reported if text.startswith("a ") and "samples" in text)
    assert site.counts("a").missing == lost.count == 42 - counted > 0
    site.host.close()


def test_an_action_that_hangs_at_shutdown_is_abandoned() -> None:
    site = HostHarness(fast(a="hangs"))
    one_episode(site)
    site.host.close(grace=0.05)
    assert [each.what for each in site.host.outcomes.lost()] == [
        "times the action did not stop in time, so that its thread was abandoned"
    ]


def test_a_replaced_action_completes_its_episodes_and_the_new_one_takes_later_ones() -> None:
    site = HostHarness(fast(a="recorded"))
    site.take((0.05, "car1", 1.0), until=0.5)
    site.when(lambda: "a 1 samples car1" in Recorded.reported)
    site.follow(fast(b="recorded"))
    site.when(lambda: "b started car1" in Recorded.reported and "a closed" in Recorded.reported)
    assert "a completed the action was changed or removed car1" in Recorded.reported
    site.host.close()


def test_an_action_is_woken_on_request_and_its_exceptions_are_counted() -> None:
    Wakes.calls = 0
    site = HostHarness(fast(a="wakes"))
    site.when(lambda: Wakes.calls > 5)
    assert [(each.what, each.count) for each in site.host.outcomes.lost()] == [("times Wakes.wake failed", 1)]
    site.host.close()


def test_an_action_without_outcomes_counts_as_failed_at_shutdown() -> None:
    site = HostHarness(fast(a="silent"))
    one_episode(site)
    site.host.close()
    counts = site.counts("a")
    assert (counts.running, counts.failed, counts.last_failure) == (0, 1, SILENT)


def test_each_outcome_is_reported_once() -> None:
    site = HostHarness(fast(a="recorded", b="raises"))
    one_episode(site)
    site.host.close()
    episode = site.published[0][0].split("/")[4]
    assert sorted(key for key, _ in site.published) == [
        f"wayside/actions/h/fast/{episode}/a",
        f"wayside/actions/h/fast/{episode}/b",
    ]
    assert any(b'"type":"dev.wayside.action.failed"' in payload for _, payload in site.published)


def test_a_missing_action_plugin_is_reported_by_field() -> None:
    rule = fast(a="recordet")
    [problem] = registry.action_problems(rule, DETECTOR)
    assert str(problem).startswith("spec.actions[0].plugin.name: ")
    assert "did you mean recorded?" in str(problem)
