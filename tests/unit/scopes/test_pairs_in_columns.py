"""Pairs in columns: all pairs at once give the events and counters of each pair by itself."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

import pytest

from detector.engine.samples.sample import Arrival
from tests.driving import Drive, a_detector, a_rule, arrival
from wayside.api import EventRule

STRANGE = (None, "far", True, 1e13, 2**60, -0.0, [1])

CLIENTS = [{"name": "c1", "labels": {"kind": "bus"}}, {"name": "c3", "labels": {"kind": "bus"}}]

SIGNALS = [{"name": "speed", "stream": "pose", "value": "msg.v"}]


def pairs(name: str, within: float, scope: dict[str, Any], **spec: Any) -> EventRule:
    position = {"stream": "pose", "x": "msg.x", "y": "msg.y", "maxAge": "1s", **scope.pop("position", {})}
    return a_rule(
        name,
        **{"scope": {"pairs": {"position": position, "within": within, **scope}}, "evaluation": {"every": "200ms"}},
        **spec,
    )


def rules() -> list[EventRule]:
    return [
        pairs("near", 6, {}, when="distance < 3", until="distance > 5", **{"for": "400ms", "cooldown": "1s"}),
        pairs("closing", 8, {}, when="closingSpeed > 0.5 && distance < 6", unknownTimeout="600ms"),
        pairs("crowded", 9, {"maxPairs": 3}, when="distance < 9"),
        pairs("roles", 8, {"a": {"where": "labels.kind == 'bus'"}}, when="distance < 4 || has(b.labels.kind)"),
        pairs("signals", 7, {"where": "a.speed > 1"}, signals=SIGNALS, when="a.speed + b.speed > 3 && distance < 6"),
        pairs("listed", 7, {}, when="[distance, 5.0].exists(d, d < 2.0)", until="distance > 4"),
    ]


def walk(seed: int, clients: int, side: float, steps: int) -> Iterator[Arrival]:
    """Clients that walk in a square; some fall silent or send nonsense."""
    draw = random.Random(seed)
    places = {f"c{number}": (draw.uniform(0, side), draw.uniform(0, side)) for number in range(clients)}
    for step in range(1, steps):
        for number, (client, (x, y)) in enumerate(places.items()):
            places[client] = x + draw.gauss(0, 0.4), y + draw.gauss(0, 0.4)
            message: dict[str, Any] = {"x": x, "y": y, "v": draw.uniform(0, 3)}
            if draw.random() < 0.05:
                message[draw.choice("xyv")] = draw.choice(STRANGE)
            if draw.random() < 0.05:
                del message[draw.choice("xyv")]
            if draw.random() < 0.8 and not (number == 0 and 20 < step < 45):
                yield arrival(step / 10 + number / 1000, client, message, "pose")


@pytest.mark.parametrize(("seed", "clients", "side", "steps"), [(1, 5, 9.0, 60), (2, 6, 6.0, 60), (3, 36, 16.0, 16)])
def test_all_pairs_at_once_give_the_events_of_single_pairs(seed: int, clients: int, side: float, steps: int) -> None:
    together, one_by_one = (Drive(a_detector(clients=CLIENTS, clientTimeout="2s"), *rules()) for _ in range(2))
    for run in one_by_one.engine.rules.values():
        run.on_evaluated = lambda evaluation: None  # an observer of each evaluation gets each one separately
    for drive in (together, one_by_one):
        drive.take(*walk(seed, clients, side, steps), until=steps / 10 + 3)
    assert [event.to_json() for event in together.events] == [event.to_json() for event in one_by_one.events]
    assert {event.episode.rule for event in together.events} == {rule.name for rule in rules()}
    for name, counters in together.engine.counters.rules.items():
        other = one_by_one.engine.counters.rules[name]
        counted = (counters.evaluations, counters.crowded_pairs, counters.misplaced, counters.started, counters.ended)
        assert counted == (other.evaluations, other.crowded_pairs, other.misplaced, other.started, other.ended), name
        assert (counters.unknowns, counters.absences, counters.errors) == (
            other.unknowns,
            other.absences,
            other.errors,
        ), name
