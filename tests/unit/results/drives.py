"""A drive of three cars for the tests of results: one falls silent for a while, two come close and part."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

from detector.engine.samples.sample import Arrival
from tests.recorded import write_json_lines
from wayside.api import Detector, EventRule
from wayside.api.documents import load_documents

START = 1_700_000_000_000_000_000
SECOND = 10**9

DETECTOR = """
apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: desk}
spec:
  mode: Standalone
  streams:
    - name: odom
      key: vehicles/${client:*}/odom
      encoding: json
      staleAfter: 1s
      position: {x: msg.x, y: msg.y}
  places:
    - {name: yard, area: [[0, 0], [40, 0], [40, 40]]}
    - {name: gate, line: [[40, 0], [40, 40]]}
    - {name: elsewhere, line: [[900, 0], [900, 40]]}
"""

RULES = """
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: too-fast}
spec:
  description: A vehicle is faster than it may be.
  evaluation: {every: 100ms}
  parameters: {limit: 21, area: [[-100, -100], [150, -100], [150, 80]]}
  signals:
    - {name: speed, stream: odom, value: msg.speed}
    - {name: gear, stream: odom, value: msg.gear}
    - {name: braking, stream: odom, value: msg.brake}
  when: speed > parameters.limit
  until: speed < 18
  actions:
    - name: watch
      deploy: {templateName: speed-watch, parameters: {vehicle: '${client}'}}
---
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: harsh}
spec:
  evaluation: {every: 100ms}
  signals:
    - {name: speed, stream: odom, value: msg.speed}
    - {name: fastest, stream: odom, value: msg.speed, over: 1s, aggregate: Max}
  when: fastest - speed > 1.5
  margin: {}
---
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: close}
spec:
  evaluation: {every: 200ms}
  scope:
    pairs: {position: {stream: odom, x: msg.x, y: msg.y}, within: 120}
  signals:
    - {name: speed, stream: odom, value: msg.speed}
    - {name: nearest, of: distance, over: 2s, aggregate: Min}
    - {name: contact, of: "timeToCollision(distance - 5.0, closingSpeed)"}
  when: distance < 50 && a.speed > 0 && (at(a.position, "yard").distance >= 0 || at(b.position, "gate").across > 0)
  until: distance > 70
---
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: slow-one}
spec:
  evaluation: {every: 1s}
  scope: {fleet: {members: "true"}}
  signals: [{name: speed, stream: odom, value: msg.speed}]
  when: members.exists(m, m.speed < 6)
"""

SILENT = (20.0, 28.0)
"""Seconds in which car2 sends nothing."""


def messages(seconds: float = 60.0) -> Iterator[tuple[int, str, dict[str, object]]]:
    """Time, key and value of each message."""
    for step in range(round(seconds * 10)):
        at = step / 10
        for car in range(3):
            if car == 2 and SILENT[0] < at < SILENT[1]:
                continue
            speed = 15 + 8 * math.sin(at * 0.4 + car) + 2 * math.sin(at * 1.7)
            x, y = 80 * math.cos(at * 0.2 + car * 0.7), 60 * math.sin(at * 0.15 + car)
            value = {"x": x, "y": y, "speed": speed, "brake": speed < 9, "gear": "D" if speed > 8 else "N"}
            yield START + step * SECOND // 10, f"vehicles/car{car}/odom", value


def arrivals() -> list[Arrival]:
    """The drive as the intake has it."""
    return [Arrival(time, "odom", key, json.dumps(value).encode()) for time, key, value in messages()]


def write(folder: Path) -> tuple[Path, Path, Path]:
    """The recording, the Detector and the rules as files."""
    files = folder / "drive.jsonl", folder / "detector.yaml", folder / "rules.yaml"
    write_json_lines(files[0], messages())
    files[1].write_text(DETECTOR)
    files[2].write_text(RULES)
    return files


def documents(folder: Path) -> tuple[Detector, list[EventRule]]:
    """The Detector and the rules."""
    _, detector, rules = write(folder)
    found = [document.object for document in load_documents([detector, rules])]
    return (
        next(each for each in found if isinstance(each, Detector)),
        [each for each in found if isinstance(each, EventRule)],
    )
