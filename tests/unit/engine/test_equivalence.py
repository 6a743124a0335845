"""The engine agrees with the reference in tests/reference on random rules and random streams.

With `WAYSIDE_EQUIVALENCE=5000` in the environment it looks at 5000 examples instead of a few.
"""

from __future__ import annotations

import json
import math
import os
from typing import Any

from hypothesis import HealthCheck, given, settings

from detector.assembly import inlets
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from tests.driving import START, a_detector, a_rule, a_stream, compiled
from tests.reference.detector import Reference, Told
from tests.reference.world import SECOND, Sample, World
from tests.unit.engine.random_drives import HALF, Message, Scene, scenes
from wayside.rules import dependency_problems

TIMEOUT, KEPT, LATENESS = 4 * SECOND, 6 * SECOND, SECOND
END = START + 40 * HALF

STREAMS = {"speed": 2 * SECOND, "pose": 3 * SECOND, "rare": None}
"""How old the newest sample may be."""


class Plain:
    """Reads payloads as Python does, since JSON proper has no NaN."""

    def decode(self, payload: bytes) -> Any:
        return json.loads(payload)["m"]

    def stamp(self, payload: bytes) -> int | None:
        return int(json.loads(payload)["t"])


def ordered(scene: Scene) -> list[tuple[int, Message]]:
    """The messages as they arrive, with their times: with clock Data those are the stamps, with ties."""
    if scene.data:
        late = sorted(scene.messages, key=lambda each: each.time + each.delay)
        return [(START + each.time * HALF, each) for each in late]
    taken: set[int] = set()
    arriving = []
    for each in sorted(scene.messages, key=lambda each: each.time):
        time = START + each.time * HALF
        while time in taken:
            time += 1
        taken.add(time)
        if scene.gap is None or not scene.gap[0] * HALF < time - START <= scene.gap[1] * HALF:
            arriving.append((time, each))
    return arriving


def by_the_engine(scene: Scene) -> list[Event]:
    clock = {"clock": "Data", "lateness": "1s", "maxAhead": "1h"} if scene.data else {}
    streams = [
        a_stream(name, staleAfter="Never" if stale is None else f"{stale // SECOND}s")
        for name, stale in STREAMS.items()
    ]
    detector = a_detector(*streams, clientTimeout="4s", buffer={"duration": "6s"}, **clock)
    entries = inlets(detector)
    decoders = dict.fromkeys(STREAMS, Plain())
    engine = Engine(detector, holder="h", decoders=decoders, read_key=entries.read_key, start=START)
    engine.set_rules(compiled(detector, *(a_rule(name, **spec) for name, spec in scene.rules.items())))
    events: list[Event] = []
    gap = None if scene.gap is None else START + scene.gap[1] * HALF
    for number, (time, each) in enumerate(ordered(scene)):
        if gap is not None and time > gap:
            events += engine.advance([], START + (scene.gap or (0, 0))[0] * HALF)
            events += engine.gap(gap)
            gap = None
        received = START + number if scene.data else time
        payload = payload_of(time, each)
        events += engine.advance([Arrival(received, each.stream, f"vehicles/{each.client}/{each.stream}", payload)], 0)
    return events + ([] if scene.data else engine.advance([], END))


def payload_of(time: int, message: Message) -> bytes:
    return json.dumps({"t": time, "m": message.message}).encode()


def by_the_reference(scene: Scene) -> list[Told]:
    world = World(TIMEOUT, dict.fromkeys(STREAMS, KEPT), STREAMS)
    arriving = ordered(scene)
    reference = Reference(scene.rules, world, lateness=LATENESS if scene.data else None, start=START, keep_starts=KEPT)
    gap = None if scene.gap is None else START + scene.gap[1] * HALF
    for number, (time, each) in enumerate(arriving):
        if gap is not None and time > gap:
            reference.advance(START + (scene.gap or (0, 0))[0] * HALF)
            reference.gap(gap)
            gap = None
        reference.arrive(Sample(time, number, each.client, each.stream, each.message, payload_of(time, each), time))
    if not scene.data:
        reference.advance(END)
    return reference.told


def rounded(value: Any) -> Any:
    """As events carry it, to nine digits: the reference sums in another order."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items() if each is not None and rounded(each) is not None}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    return value


def plainly(events: list[Event]) -> list[Told]:
    return [
        Told(
            event.rule,
            event.subject,
            event.start_time if event.end_time is None else event.end_time,
            event.onset_time,
            "" if event.reason is None else event.reason.value,
            rounded(event.values),
        )
        for event in events
    ]


@settings(
    max_examples=int(os.environ.get("WAYSIDE_EQUIVALENCE", "150")),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(scenes())
def test_the_engine_does_what_the_reference_says(scene: Scene) -> None:
    rules = [a_rule(name, **spec) for name, spec in scene.rules.items()]
    assert dependency_problems(rules) == {}
    told = by_the_reference(scene)
    expected = [Told(t.rule, t.subject, t.time, t.onset, t.reason, rounded(t.values)) for t in told]
    assert plainly(by_the_engine(scene)) == expected
