"""The rules over the generated intersection find what plain numpy finds in the same data."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

from detector.assembly import RuleIndex, stream_readers
from detector.assembly.checking import findings
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from detector.results.episodes import episodes_of
from detector.results.nearest import nearest_moments
from detector.results.tracing import Tracer
from examples.intersection.generator import RED, START_NS, messages
from tests.guides import ROOT
from tests.unit.examples.intersection_truths import TRUTHS, USERS, Pair, Span, acceleration, time_to_collision
from wayside.api import Detector, EventRule
from wayside.api.documents import load_documents

FOLDER = ROOT / "examples/intersection"
DOCUMENTS = load_documents([FOLDER / "detector.yaml", FOLDER / "rules.yaml"])
TICK = 100_000_000


@pytest.fixture(scope="module")
def tracer() -> Tracer:
    """Sees what the rules see."""
    return Tracer()


@pytest.fixture(scope="module")
def events(tracer: Tracer) -> list[Event]:
    """The events of all rules."""
    objects = [document.object for document in DOCUMENTS]
    detector = next(each for each in objects if isinstance(each, Detector))
    rules = [each for each in objects if isinstance(each, EventRule)]
    readers = stream_readers(detector)
    compiled, refused = RuleIndex().compile(rules, detector, readers.fields, readers.places)
    assert refused == []
    engine = Engine(detector, holder="h", decoders=readers.decoders, read_key=readers.read_key, start=START_NS)
    engine.observers.observer = tracer
    engine.set_rules(compiled)
    tracer.attend(engine)
    arrivals = [
        Arrival(time, key.rpartition("/")[2], key, json.dumps(value).encode()) for time, key, value in messages()
    ]
    return engine.advance(arrivals, 0) + [event for step in engine.finish() for event in step]


@pytest.fixture(scope="module")
def found(events: list[Event]) -> dict[str, list[Span]]:
    """The episodes of each rule."""
    spans: dict[str, list[Span]] = {rule: [] for rule in TRUTHS}
    ends = {event.episode.id: event for event in events if event.end_time is not None}
    for event in events:
        if event.end_time is None:
            last = ends.get(event.episode.id)
            known = last is not None and last.reason is not None and last.reason.value == "Until"
            end = (
                (last.end_time - START_NS) // TICK if known and last is not None and last.end_time is not None else None
            )
            spans[event.episode.rule].append(
                Span(event.episode.subject, (event.episode.start_time - START_NS) // TICK, end)
            )
    return {rule: sorted(each) for rule, each in spans.items()}


@pytest.mark.parametrize("rule", TRUTHS)
def test_a_rule_finds_the_episodes_that_numpy_finds(rule: str, found: dict[str, list[Span]]) -> None:
    expected = TRUTHS[rule]()
    assert expected
    assert [each[:2] for each in found[rule]] == [each[:2] for each in expected]
    assert [a.end for a, b in zip(found[rule], expected, strict=True) if b.end is not None] == [
        each.end for each in expected if each.end is not None
    ]


def test_the_minimum_time_to_collision_of_an_episode_matches_numpy(events: list[Event]) -> None:
    ended = [each for each in events if each.episode.rule == "least-time-to-collision" and each.end_time is not None]
    assert ended
    for event in ended:
        a, b = (USERS[name] for name in event.episode.subject.split("+"))
        assert event.end_time is not None
        first, last = (event.episode.start_time - START_NS) // TICK, (event.end_time - START_NS) // TICK
        times = time_to_collision(Pair(a, b))[first : last + 1]
        assert event.values["least"] == pytest.approx(np.nanmin(times), abs=1e-9)
        assert event.values["leastAt"] == pytest.approx((START_NS + (first + np.nanargmin(times)) * TICK) / 1e9)


def test_near_misses_match_numpy(events: list[Event], tracer: Tracer) -> None:
    trace = tracer.trace()
    rules = {name: run.rule for name, run in tracer.engine.rules.items()} if tracer.engine is not None else {}
    moments = nearest_moments("", rules, trace.subjects, episodes_of("", events, trace))
    braked = {event.episode.subject for event in events if event.episode.rule == "hard-braking"}
    expected = {name: -5 - np.nanmin(acceleration(user)) for name, user in USERS.items() if name not in braked}
    found: dict[str, float] = {}
    for moment in moments:
        found.setdefault(moment.subject, moment.margin)
    never = [name for name in found if name not in braked]
    assert never == sorted(expected, key=lambda name: -expected[name])[: len(never)]
    assert never
    assert [found[name] for name in never] == pytest.approx([expected[name] for name in never])


def test_each_rule_has_a_truth_and_at_most_25_lines() -> None:
    texts = (FOLDER / "rules.yaml").read_text("utf-8").split("---\n")
    lines = {line.split("name: ")[1].split(",")[0]: len(text.splitlines()) for text in texts for line in _names(text)}
    assert lines.keys() == TRUTHS.keys()
    assert max(lines.values()) <= 25


def _names(text: str) -> Iterator[str]:
    return (line for line in text.splitlines() if line.startswith("metadata:"))


def test_the_check_finds_nothing() -> None:
    assert [problem for found in findings(DOCUMENTS) for problem in found] == []


def test_the_same_seed_gives_the_same_recording() -> None:
    assert [*messages()] == [*messages()]
    assert [*messages(1)] != [*messages()]
    assert RED[0][0] > 0
