"""Drives an engine from a test: short definitions of detectors and rules, samples at seconds after a start.

Only the data is simulated: keys, decoders and rules are those of `detector run`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from detector.assembly import make_engine, stream_readers
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from wayside.api import API_VERSION, Detector, EventRule
from wayside.rules import CompiledRule, compile_rule

START = 1_767_225_600 * 10**9
"""A whole second, in nanoseconds since the epoch."""

SECOND = 10**9

SPEED = {"name": "speed", "stream": "speed", "value": "msg.v"}
"""A signal."""

POSITION = {"stream": "pose", "x": "msg.x", "y": "msg.y", "maxAge": "30s"}
"""Positions stay valid for long: tests that are not about their age send few."""


def at(seconds: float) -> int:
    """The time this number of seconds after the start, to the microsecond, in nanoseconds since the epoch."""
    return START + round(seconds * 1e6) * 1000


def a_stream(name: str, **fields: Any) -> dict[str, Any]:
    return {"name": name, "key": f"vehicles/${{client:*}}/{name}", "encoding": "json", **fields}


def a_detector(*streams: Mapping[str, Any], **spec: Any) -> Detector:
    """A Detector with JSON streams pose and speed, or those given."""
    return Detector.model_validate(
        {
            "apiVersion": API_VERSION,
            "kind": "Detector",
            "metadata": {"name": "d"},
            "spec": {"streams": list(streams or (a_stream("pose"), a_stream("speed"))), **spec},
        }
    )


def a_rule(name: str = "r", **spec: Any) -> EventRule:
    return EventRule.model_validate(
        {"apiVersion": API_VERSION, "kind": "EventRule", "metadata": {"name": name}, "spec": spec}
    )


def a_deploy(name: str, template: str = "app", **fields: Any) -> dict[str, Any]:
    return {"name": name, "deploy": {"templateName": template, **fields}}


def arrival(seconds: float, client: str, value: Any, stream: str = "speed") -> Arrival:
    """A JSON message of a client, or a payload as it is where `value` is bytes."""
    payload = value if isinstance(value, bytes) else json.dumps(value).encode()
    return Arrival(at(seconds), stream, f"vehicles/{client}/{stream}", payload)


def speed(seconds: float, value: Any, client: str = "car") -> Arrival:
    """A sample of stream speed."""
    return arrival(seconds, client, {"v": value})


def place(seconds: float, client: str, x: float, y: float = 0.0) -> Arrival:
    """A sample of stream pose."""
    return arrival(seconds, client, {"x": x, "y": y}, "pose")


def compiled(detector: Detector, *rules: EventRule) -> list[CompiledRule]:
    return [compile_rule(rule, detector) for rule in rules]


def an_engine(detector: Detector, *rules: EventRule, start: float = 0.0) -> Engine:
    engine = make_engine(detector, stream_readers(detector), holder="h", start=at(start))
    engine.set_rules(compiled(detector, *rules))
    return engine


class Drive:
    """An engine and the current time."""

    def __init__(self, detector: Detector, *rules: EventRule, start: float = 0.0) -> None:
        self.detector = detector
        self.engine = an_engine(detector, *rules, start=start)
        self.events: list[Event] = []

    def take(self, *arrivals: Arrival, until: float) -> list[str]:
        """Advance the time; return the events in short form (see `reported`)."""
        return self.note(self.engine.advance(arrivals, at(until)))

    def finish(self) -> list[str]:
        """End the input; return the remaining events."""
        return self.note([event for events in self.engine.finish() for event in events])

    def note(self, events: Sequence[Event]) -> list[str]:
        self.events += events
        return reported(events)


def reported(events: Sequence[Event]) -> list[str]:
    """Events in short form: `r car1 started 3`, `r car1 Until 5`; times in seconds after the start."""
    return [
        f"{event.episode.rule} {event.episode.subject} {event.reason or 'started'} {(event.time - START) / 1e9:g}"
        for event in events
    ]


def lines(events: Sequence[Event]) -> list[str]:
    return [event.to_json() for event in events]
