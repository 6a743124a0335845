"""A fleet's recordings from a seed: MCAP and JSON lines, some of them broken."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator
from pathlib import Path

from mcap.writer import Writer

from tests.recorded import write_json_lines

START = 1_700_000_000_000_000_000
SECOND = 10**9
HZ = 10

DETECTOR = """
apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: fleet}
spec:
  mode: Standalone
  clientTimeout: 10s
  streams:
    - {name: odom, key: 'vehicles/${client:*}/odom', encoding: json, staleAfter: 1s}
"""

TOO_FAST = """
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: too-fast}
spec:
  evaluation: {every: 100ms}
  signals:
    - {name: speed, stream: odom, value: msg.speed}
    - {name: fastest, stream: odom, value: msg.speed, over: 1s, aggregate: Max}
  when: speed > 21
  until: fastest < 20
"""

HARSH = """
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: harsh}
spec:
  evaluation: {every: 200ms}
  signals:
    - {name: speed, stream: odom, value: msg.speed}
    - {name: fastest, stream: odom, value: msg.speed, over: 1s, aggregate: Max}
  when: fastest - speed > 1.5
  for: 300ms
  cooldown: 2s
"""

CLOSE = """
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: close}
spec:
  evaluation: {every: 200ms}
  scope:
    pairs: {position: {stream: odom, x: msg.x, y: msg.y}, within: 120}
  signals: [{name: speed, stream: odom, value: msg.speed}]
  when: distance < 50 && a.speed > 0
  margin: {distance: 10, speed: 5}
  until: distance > 70
"""

RULES = "---".join((TOO_FAST, HARSH, CLOSE))


def drive(seed: int, seconds: float, cars: int = 3) -> Iterator[tuple[int, str, dict[str, object]]]:
    """Time, key and value of each message of one recording; one car sends nothing for a while."""
    chance = random.Random(seed)
    phases = [(chance.uniform(0, 6), chance.uniform(0.2, 0.5), chance.uniform(5, 8)) for _ in range(cars)]
    silent = chance.uniform(0, seconds * 0.7)
    begin = START + seed * 3600 * SECOND
    for step in range(round(seconds * HZ)):
        at = step / HZ
        for car, (phase, pace, swing) in enumerate(phases):
            if car == cars - 1 and silent < at < silent + 8:
                continue
            speed = 15 + swing * math.sin(at * pace + phase) + 2 * math.sin(at * 1.7 + phase)
            x, y = 80 * math.cos(at * 0.2 + phase), 60 * math.sin(at * 0.15 + phase)
            value = {"x": round(x, 3), "y": round(y, 3), "speed": round(speed, 3)}
            yield begin + step * SECOND // HZ, f"vehicles/car{car}/odom", value


def write_mcap(path: Path, seed: int, seconds: float, cars: int = 3) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8192)
        writer.start()
        channels: dict[str, int] = {}
        for time, key, value in drive(seed, seconds, cars):
            if key not in channels:
                channels[key] = writer.register_channel(f"/{key}", "json", 0)
            writer.add_message(channels[key], time, json.dumps(value).encode(), time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def write_fleet(folder: Path, recordings: int, seconds: float, broken: int = 3) -> Path:
    """The folder with Detector, rules, and a folder `drives` with the recordings; every other one is MCAP.

    The first broken file is no recording, the second has a bad line, the third is truncated.
    """
    (folder / "detector.yaml").write_text(DETECTOR)
    (folder / "rules.yaml").write_text(RULES)
    drives = folder / "drives"
    drives.mkdir()
    for seed in range(recordings):
        name = f"car-{seed:03}-drive"
        if seed % 2:
            write_json_lines(drives / f"{name}.jsonl", drive(seed, seconds))
        else:
            write_mcap(drives / f"{name}.mcap", seed, seconds)
    for number in range(broken):
        name = drives / f"broken-{number:03}-drive"
        if number % 3 == 0:
            name.with_suffix(".mcap").write_bytes(b"no recording at all")
        elif number % 3 == 1:
            path = write_json_lines(name.with_suffix(".jsonl"), drive(1000 + number, 5))
            path.write_text(path.read_text() + "{nothing}\n")
        else:
            path = write_mcap(name.with_suffix(".mcap"), 1000 + number, seconds)
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return drives
