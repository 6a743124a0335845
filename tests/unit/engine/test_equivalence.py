"""The engine agrees with the reference in tests/reference on random rules and random streams.

With `WAYSIDE_EQUIVALENCE=5000` in the environment it looks at 5000 examples instead of a few.
"""

from __future__ import annotations

import json
import math
import os
from itertools import groupby
from typing import Any

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from detector.assembly import stream_readers
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival, DecodeError
from tests.driving import START, a_detector, a_rule, a_stream, compiled
from tests.reference.detector import Reference, Reported
from tests.reference.places import located
from tests.reference.samples import SECOND, Received, Sample, listed
from tests.reference.signals import set_places
from tests.unit.engine.random_drives import BROKEN, HALF, PLACES, POSITION, Message, Scene, scenes
from wayside.rules import dependency_problems

TIMEOUT, KEPT = 4 * SECOND, 6 * SECOND
END = START + 40 * HALF

STREAMS = {"speed": 2 * SECOND, "pose": 3 * SECOND, "rare": None, "list": 2 * SECOND}
"""How old the newest sample may be."""

LISTS = frozenset({"list"})
"""The streams with items."""

LIST = {"key": "stations/${station:*}/list", "items": "msg.list", "client": "${item.id}"}


class PythonJsonDecoder:
    """Reads payloads as Python does, since JSON proper has no NaN."""

    def decode(self, payload: bytes) -> Any:
        return self._read(payload)["m"]

    def stamp(self, payload: bytes) -> int | None:
        return int(self._read(payload)["t"])

    def _read(self, payload: bytes) -> Any:
        try:
            return json.loads(payload)
        except ValueError as error:
            raise DecodeError(str(error)) from None


def ordered(scene: Scene) -> list[tuple[int, Message]]:
    """The messages as they arrive, with their times, many of which are equal; with clock Data those are the stamps."""
    delayed = sorted(scene.messages, key=lambda each: each.time + (each.delay if scene.data else 0))
    return [(START + each.time * HALF, each) for each in delayed]


def by_the_engine(scene: Scene, cut: int) -> list[Event]:
    """`cut`: one call has the messages of this number of times, except for a gap."""
    lateness = f"{scene.lateness * 500}ms"
    clock = {"clock": "Data", "lateness": lateness, "maxAhead": "1h"} if scene.data else {}
    caps = {"speed": {"count": scene.count}, "pose": {"bytes": scene.pose_bytes}}
    streams = [
        a_stream(
            name,
            staleAfter="Never" if stale is None else f"{stale // SECOND}s",
            buffer=_given(caps.get(name, {})),
            **({"position": POSITION} if name == "pose" else {}),
            **(LIST if name in LISTS else {}),
        )
        for name, stale in STREAMS.items()
    ]
    buffer = _given({"duration": "6s", "bytes": scene.all_bytes})
    detector = a_detector(*streams, clientTimeout="4s", buffer=buffer, places=[*PLACES], **clock)
    readers = stream_readers(detector)
    decoders = dict.fromkeys(STREAMS, PythonJsonDecoder())
    engine = Engine(detector, holder="h", decoders=decoders, read_key=readers.read_key, start=START)
    engine.set_rules(compiled(detector, *(a_rule(name, **spec) for name, spec in scene.rules.items())))
    events: list[Event] = []
    gap, together = scene.gap, list[Arrival]()
    times = groupby(enumerate(ordered(scene)), key=lambda each: each[1][0])
    for count, (time, messages) in enumerate(times, start=1):
        if gap is not None and time > START + gap[0] * HALF:
            events += engine.advance(together, START + gap[0] * HALF)
            events += engine.gap(START + gap[1] * HALF)
            gap, together = None, []
        together += [
            Arrival(
                START + number if scene.data else time,
                each.stream,
                f"{'stations' if each.stream in LISTS else 'vehicles'}/{each.client}/{each.stream}",
                payload_of(time, each),
            )
            for number, (_, each) in messages
        ]
        if count % cut == 0:
            events += engine.advance(together, 0)
            together = []
    events += engine.advance(together, 0)
    events += [] if scene.data else engine.advance([], END)
    return events + [event for step in engine.finish() for event in step]


def _given(fields: dict[str, Any]) -> dict[str, Any]:
    """The given fields, with byte counts in the form of the kind."""
    return {name: str(value) if name == "bytes" else value for name, value in fields.items() if value is not None}


def payload_of(time: int, message: Message) -> bytes:
    whole = json.dumps({"t": time, "m": message.message}).encode()
    return whole[:-1] if message.message is BROKEN else whole


def by_the_reference(scene: Scene) -> list[Reported]:
    set_places(PLACES, POSITION)
    counts, sizes = _given({"speed": scene.count}), _given({"pose": scene.pose_bytes})
    received = Received(TIMEOUT, dict.fromkeys(STREAMS, KEPT), STREAMS, counts, sizes, scene.all_bytes, items=LISTS)
    lateness = scene.lateness * HALF if scene.data else None
    rules = {name: located(spec, {"pose": POSITION}) for name, spec in scene.rules.items()}
    reference = Reference(rules, received, lateness=lateness, start=START, keep_starts=KEPT)
    gap = scene.gap
    for number, (time, each) in enumerate(ordered(scene)):
        if gap is not None and time > START + gap[0] * HALF:
            reference.advance(START + gap[0] * HALF)
            reference.gap(START + gap[1] * HALF)
            gap = None
        if scene.data and each.message is BROKEN:
            continue  # it has no stamp, so nobody knows when it was sent
        payload = payload_of(time, each)
        if each.stream not in LISTS:
            reference.arrive(Sample(time, number, each.client, each.stream, each.message, payload, time))
            continue
        items = listed(each.message)
        reference.nothing(time)
        for place, (client, item) in enumerate(items.items()):
            share, order = len(payload) // len(items), number + place / (len(items) + 1)
            reference.arrive(Sample(time, order, client, each.stream, each.message, payload, time, item, share=share))
    if not scene.data:
        reference.advance(END)
    reference.finish()
    return reference.reported


def rounded(value: Any) -> Any:
    """As events carry it, to nine digits, since the reference sums in another order; keys are sorted."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in sorted(value.items()) if rounded(each) is not None}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    return value


def plainly(events: list[Event]) -> list[Reported]:
    return [
        Reported(
            event.episode.rule,
            event.episode.subject,
            event.time,
            event.episode.onset_time,
            "" if event.reason is None else event.reason.value,
            rounded(event.values),
        )
        for event in events
    ]


def objects(*values: tuple[int, float]) -> tuple[Message, ...]:
    """Lists with one object, at these times."""
    return tuple(
        Message(time, 0, "a", "list", {"n": 0.0, "list": [{"id": "o", "v": value, "x": 0.0, "y": 0.0}]})
        for time, value in values
    )


_FASTEST = {"name": "s", "stream": "list", "value": "item.v", "over": "5s", "aggregate": "Max"}
_RETURNING = Scene(
    {"r": {"signals": [_FASTEST], "when": "s > 2", "evaluation": {"every": "500ms"}}},
    objects((1, 1.0), (3, 3.0), (11, 1.0), (12, 3.0)),
    *(False, 0, None, None, None, None),
)
"""An object is lost, and another one comes under its name."""


@example(_RETURNING, 1)
@settings(
    max_examples=int(os.environ.get("WAYSIDE_EQUIVALENCE", "100")),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(scenes(), st.sampled_from([1, 1, 4, 1000]))
def test_the_engine_agrees_with_the_reference(scene: Scene, cut: int) -> None:
    rules = [a_rule(name, **spec) for name, spec in scene.rules.items()]
    assert dependency_problems(rules) == {}
    reported = by_the_reference(scene)
    expected = [Reported(t.rule, t.subject, t.time, t.onset, t.reason, rounded(t.values)) for t in reported]
    assert repr(plainly(by_the_engine(scene, cut))) == repr(expected)  # so that the sign of zero counts
