"""Actions get each sample of an episode's window exactly once, in any order of arrival, on both clocks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from detector.engine.consequences import (
    REPLACED,
    ActionRun,
    Consequence,
    EpisodeEnded,
    RunCompleted,
    RunSamples,
    RunStarted,
)
from detector.engine.engine import Engine
from detector.engine.samples.sample import Arrival
from tests.driving import START, a_detector, a_rule, a_stream, arrival, at, compiled
from tests.driving import an_engine as a_deaf_engine
from wayside.api import Detector, EventRule
from wayside.rules import RuleError

STREAMS = (a_stream("speed", stamp="msg.t"), a_stream("load", stamp="msg.t"), a_stream("map", latched=True))
BUFFER = {"duration": "3s"}
WALL = a_detector(*STREAMS, buffer=BUFFER, clientTimeout="60s")
DATA = a_detector(*STREAMS, buffer=BUFFER, clientTimeout="60s", clock="Data", lateness="500ms", maxAhead="1h")


def an_engine(detector: Detector, *rules: EventRule) -> Engine:
    engine = a_deaf_engine(detector, *rules)
    engine.consequences.wanted = True
    return engine


def an_action(name: str = "keep", **window: Any) -> dict[str, Any]:
    return {"name": name, "plugin": {"name": "keeper", "window": window}}


def fast(*actions: dict[str, Any], **spec: Any) -> EventRule:
    return a_rule(
        "fast",
        signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
        when="v > 0.5",
        evaluation={"every": "100ms"},
        actions=list(actions),
        **spec,
    )


RULE = fast(an_action(before="1s", after="700ms"), an_action("all", clients="All", streams=["load"], after="200ms"))


def run(engine: Engine, batches: Sequence[Sequence[Arrival]], until: float) -> list[Consequence]:
    reported: list[Consequence] = []
    for batch in batches:
        engine.advance(batch, batch[-1].received)
        reported += engine.consequences.drain(engine.now)
    engine.advance((), at(until))
    return reported + engine.consequences.drain(engine.now)


def collected(reported: Sequence[Consequence], run: ActionRun) -> list[tuple[str, str, int, bytes]]:
    return [
        (sample.client, sample.stream, sample.time, sample.payload)
        for each in reported
        if isinstance(each, RunSamples) and each.run == run
        for sample in each.samples
    ]


def message(seconds: float, client: str, stream: str, value: float, late: float = 0.0) -> Arrival:
    """Received `late` seconds after its stamp."""
    return arrival(seconds + late, client, {"v": value, "t": (START + round(seconds * 1e9)) / 1e9}, stream)


messages = st.lists(
    st.tuples(
        st.integers(1, 159),
        st.sampled_from(["car1", "car2"]),
        st.sampled_from(["speed", "load"]),
        st.sampled_from([0.0, 1.0]),
        st.integers(0, 4),
    ),
    min_size=1,
    max_size=60,
)


@settings(deadline=None, max_examples=30)
@given(drawn=messages, cuts=st.lists(st.integers(1, 59), max_size=8), on_data=st.booleans())
@example(
    drawn=[(21, "car1", "speed", 1.0, 0), (41, "car1", "speed", 0.0, 0), (49, "car1", "load", 0.0, 0)],
    cuts=[],
    on_data=False,
)
@example(  # at the borders of both windows: the episode starts at 2 s and ends at 3 s
    drawn=[
        *[(tick, "car1", "load", 0.0, 0) for tick in (20, 40, 60, 64, 74)],
        *[(39, "car1", "speed", 1.0, 0), (59, "car1", "speed", 0.0, 0)],
    ],
    cuts=[],
    on_data=True,
)
def test_exactly_the_samples_of_a_window_are_delivered_once_each(
    drawn: list[tuple[int, str, str, float, int]], cuts: list[int], on_data: bool
) -> None:
    arrivals = [
        message(tick / 20, client, stream, value, late / 10 if on_data else 0.0)
        for tick, client, stream, value, late in drawn
    ]
    arrivals.sort(key=lambda each: each.received)
    arrivals = [replace(each, received=each.received + index) for index, each in enumerate(arrivals)]
    if on_data:  # time advances with the stamps
        arrivals.append(replace(message(11.0, "car2", "load", 0.0), received=at(12)))
    edges = sorted({0, *(cut for cut in cuts if cut < len(arrivals)), len(arrivals)})
    batches = [arrivals[first:last] for first, last in pairwise(edges) if last > first]
    engine = an_engine(DATA if on_data else WALL, RULE)
    reported = run(engine, batches, 12.0)
    assert engine.consequences.running.keys() == {
        each.run for each in reported if isinstance(each, RunStarted) and not completed(reported, each.run)
    }
    begun = [each for each in reported if isinstance(each, RunStarted)]
    ends = {each.run: each.event.end_time for each in reported if isinstance(each, EpisodeEnded)}
    for each in begun:
        end = ends.get(each.run)
        expected = [
            (client, stream, time, sample.payload)
            for sample in arrivals
            for client, stream in [tuple(sample.key.split("/")[1:])]
            for time in [sample.received if not on_data else round(json.loads(sample.payload)["t"] * 1e6) * 1000]
            if in_window(each, client, stream, time, end) and time <= engine.now
        ]
        assert sorted(collected(reported, each.run)) == sorted(expected)


def in_window(begun: RunStarted, client: str, stream: str, time: int, end: int | None) -> bool:
    until = 2**63 if end is None else end
    if begun.run.action == "all":
        return stream == "load" and begun.event.episode.onset_time < time <= until + 200_000_000
    return (
        client in begun.event.episode.clients and begun.event.episode.onset_time - 10**9 < time <= until + 700_000_000
    )


def completed(reported: Sequence[Consequence], run: ActionRun) -> bool:
    return any(isinstance(each, RunCompleted) and each.run == run for each in reported)


def order(reported: Sequence[Consequence]) -> list[str]:
    return [type(each).__name__ for each in reported]


def speeds(*values: tuple[float, float]) -> list[list[Arrival]]:
    return [[arrival(seconds, "car1", {"v": value})] for seconds, value in values]


PLAIN = a_detector(a_stream("speed"), a_stream("map", latched=True), buffer=BUFFER, clientTimeout="60s")


def test_a_run_is_passed_on_in_order_and_completed_once_time_has_passed_its_window() -> None:
    engine = an_engine(PLAIN, fast(an_action(before="1s", after="1s")))
    reported = run(engine, speeds((0.55, 0.0), (1.05, 1.0), (2.05, 0.0), (2.55, 0.0)), 3.0)
    assert order(reported) == ["RunStarted", "RunSamples", "EpisodeEnded", "RunSamples"]
    engine.advance((), at(3.1))
    assert order(engine.consequences.drain(engine.now)) == ["RunCompleted"]
    assert not engine.consequences.running
    assert all(lane.inserted is None for lane in engine.buffer), "nobody keeps what comes any more"


def test_latched_samples_are_delivered_with_the_window_whatever_their_age() -> None:
    engine = an_engine(PLAIN, fast(an_action(streams=["speed"], before="500ms")))
    first = [arrival(0.5, "car1", {"m": 1}, "map"), arrival(0.6, "car2", {"m": 2}, "map")]
    reported = run(engine, [first, *speeds((9.05, 1.0))], 9.2)
    [sampled] = [each for each in reported if isinstance(each, RunSamples)]
    assert [(sample.stream, sample.client) for sample in sampled.samples] == [("map", "car1"), ("speed", "car1")]


def test_samples_evicted_by_a_cap_are_still_reported_as_missing() -> None:
    tight = a_detector(a_stream("speed", buffer={"count": 1}), clientTimeout="60s")
    engine = an_engine(tight, fast(an_action()))
    engine.advance([arrival(0.05, "car1", {"v": 1})], at(0.2))
    engine.advance([arrival(0.2 + each / 1000, "car1", {"v": 1}) for each in range(1, 50)], at(0.3))
    reported = engine.consequences.drain(engine.now)
    assert sum(len(each.samples) for each in reported if isinstance(each, RunSamples)) == 49


def test_a_dry_run_runs_no_action() -> None:
    engine = an_engine(PLAIN, fast(an_action(), dryRun=True))
    assert run(engine, speeds((0.05, 1.0), (1.05, 0.0)), 3.0) == []


def test_at_shutdown_open_windows_are_truncated() -> None:
    engine = an_engine(PLAIN, fast(an_action()))
    run(engine, speeds((0.05, 1.0)), 1.0)
    reported = engine.consequences.cut(engine.now, "it stops")
    assert [each for each in reported if isinstance(each, RunCompleted)] == reported[-1:]
    assert reported[-1].cut == "it stops"


def test_open_episodes_are_handed_over_to_changed_actions() -> None:
    engine = an_engine(PLAIN, fast(an_action("a"), an_action("b")))
    run(engine, speeds((0.05, 1.0)), 1.0)
    engine.set_rules(compiled(PLAIN, fast(an_action("b"), an_action("c"))))
    reported = engine.consequences.drain(engine.now)
    assert [(each.run.action, each.cut) for each in reported if isinstance(each, RunCompleted)] == [("a", REPLACED)]
    assert [(each.run.action, each.resumed) for each in reported if isinstance(each, RunStarted)] == [("c", True)]


def test_an_action_with_other_parameters_is_another_action() -> None:
    other = {"name": "keep", "plugin": {"name": "keeper", "parameters": {"folder": "b"}}}
    engine = an_engine(PLAIN, fast({"name": "keep", "plugin": {"name": "keeper"}}))
    run(engine, speeds((0.05, 1.0)), 1.0)
    engine.set_rules(compiled(PLAIN, fast(other)))
    assert order(engine.consequences.drain(engine.now)) == ["RunCompleted", "RunStarted"]


def test_a_changed_rule_ends_its_episodes_and_their_windows_continue() -> None:
    engine = an_engine(PLAIN, fast(an_action(after="1s")))
    run(engine, speeds((0.05, 1.0)), 1.0)
    engine.set_rules([])
    reported = run(engine, speeds((1.5, 1.0), (2.5, 1.0)), 3.0)
    assert order(reported) == ["EpisodeEnded", "RunSamples", "RunCompleted"]
    assert [len(each.samples) for each in reported if isinstance(each, RunSamples)] == [1]


def test_samples_after_the_completion_of_their_window_are_counted() -> None:
    engine = an_engine(DATA, fast(an_action(streams=["speed"], before="1s")))
    reported = run(
        engine,
        [
            [message(0.05, "car1", "speed", 1.0)],
            [message(1.05, "car1", "speed", 0.0)],
            [message(3.05, "car1", "speed", 0.0)],
            [message(0.5, "car1", "speed", 1.0, late=3.0), message(1.9, "car1", "speed", 1.0, late=1.9)],
        ],
        4.0,
    )
    assert order(reported)[-1] == "RunCompleted"
    assert engine.consequences.too_late == 1, "the second of them is in no window"
    run(engine, [[message(20.0, "car1", "speed", 0.0)]], 21.0)
    assert all(lane.inserted is None for lane in engine.buffer), "nobody waits for late ones any more"


def test_parameters_of_actions_are_rendered_at_the_start_independently_of_each_other() -> None:
    values = {"text": "${client} at ${v}", "missing": "${labels.plate}"}
    engine = an_engine(PLAIN, fast({"name": "n", "plugin": {"name": "teller", "values": values}}))
    [begun, *_] = run(engine, speeds((0.05, 1.0)), 1.0)
    assert isinstance(begun, RunStarted)
    assert begun.rendered.values == {"text": "car1 at 1"}
    assert list(begun.rendered.problems) == ["missing"]


def test_a_window_that_reaches_back_further_than_the_buffer_is_refused() -> None:
    detector: Detector = a_detector(a_stream("speed", buffer={"duration": "5s"}))
    rule = fast(an_action(before="4s"), **{"for": "2s"})
    with pytest.raises(RuleError) as refused:
        compiled(detector, rule)
    text = str(refused.value)
    assert "spec.actions[0].plugin.window.before" in text
    assert "4s plus the rule's for (2s) exceeds the 5 s that Detector d keeps of stream speed" in text
