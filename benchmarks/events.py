"""Creating and encoding an event, compared with `json.dumps` of an existing dict.

An event is that of a rule over single clients with one number, once small and once with a classification. Making counts
from the start of the episode on: its id, the episode, and the event. Each round measures all; ratios are to the
baseline of the same round. Times are of the processor: other programs on the machine hardly disturb.

    python benchmarks/events.py [--rounds 9] [--events 20000]
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from detector.engine.episodes.current import DetectorIdentity, EpisodeState, new_record
from detector.engine.episodes.events import Event
from detector.engine.episodes.subjects import Subject
from wayside.api import Detector, EventRule
from wayside.rules import CompiledRule, compile_rule

START = 1_767_225_600_000_000_000
STEP = 100_000_000
"""Nanoseconds from one event to the next: ten of them share a second."""
CLIENTS = 100
IDENTITY = DetectorIdentity("bench", "bench", "default")
CLASSIFICATION = {"overarchingPurpose": ["Safety"], "timeSensitivity": ["Immediate"]}


def a_rule(**spec: Any) -> CompiledRule:
    detector = Detector.model_validate(
        {
            "kind": "Detector",
            "metadata": {"name": "bench"},
            "spec": {"streams": [{"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "json"}]},
        }
    )
    rule = EventRule.model_validate(
        {
            "kind": "EventRule",
            "metadata": {"name": "fast"},
            "spec": {
                "signals": [{"name": "speed", "stream": "speed", "value": "msg.v"}],
                "when": "speed > 10",
                "evaluation": {"every": "100ms"},
                **spec,
            },
        }
    )
    return compile_rule(rule, detector)


def make(rule: CompiledRule, number: int) -> Event:
    """As an evaluation makes the event of a start."""
    now = START + number * STEP
    subject = Subject((f"car-{number % CLIENTS}",))
    record = new_record(rule, IDENTITY, subject, now, now, {"speed": number / 7})
    return EpisodeState(record, {}).started(rule, IDENTITY)


def cost(work: Callable[[Any], object], given: Sequence[Any]) -> float:
    """Microseconds for each of the given."""
    gc.collect()
    begin = time.thread_time_ns()
    for each in given:
        work(each)
    return (time.thread_time_ns() - begin) / len(given) / 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--events", type=int, default=20_000)
    options = parser.parse_args()
    numbers = range(options.events)
    rules = {"small": a_rule(), "classified": a_rule(classification=CLASSIFICATION)}
    for name, rule in rules.items():
        costs: dict[str, list[float]] = {"dumps": [], "make": [], "print": []}
        for _ in range(options.rounds):
            events = [make(rule, number) for number in numbers]
            ready = [event.cloud_event() for event in events]
            costs["dumps"].append(cost(json.dumps, ready))
            costs["make"].append(cost(partial(make, rule), numbers))
            costs["print"].append(cost(Event.to_json, events))
        dumps = statistics.median(costs["dumps"])
        for what in ("make", "print"):
            median = statistics.median(costs[what])
            print(
                f"{name:>10}: {what:5} {median:6.2f} us (best {min(costs[what]):.2f}), json.dumps of a dict "
                f"{dumps:6.2f} us, ratio {median / dumps:.2f}"
            )


if __name__ == "__main__":
    main()
