"""A recording that is cut into pieces has the same episodes as one that is not."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from detector.assembly import RuleIndex, stream_readers
from detector.mining.cutting import END, START, PieceTimes, warmup_of
from detector.mining.joining import flaw_of, joined
from detector.mining.pieces import PieceJob, observe
from detector.mining.sources import InputRecording
from detector.mining.work import MiningJob, RecordingResult, decode_mined, mine_recording
from tests.driving import a_detector, a_rule, a_stream
from wayside.api import Detector, EventRule

T0 = 1_700_000_000_000_000_000
SECOND = 10**9


def messages(chance: random.Random, seconds: int) -> Iterator[tuple[int, str, Any]]:
    """Three cars on two streams, that fall silent for seconds or for long enough to be lost; some values are odd."""
    found: list[tuple[int, str, Any]] = []
    for car in range(3):
        for stream, hertz in (("odom", 10), ("slow", 1)):
            at, v = chance.uniform(0, 3), chance.uniform(0, 30)
            while at < seconds:
                if chance.random() < 0.01:
                    at += chance.choice([0.7, 3.0, 9.0, 25.0])
                v = min(max(v + chance.gauss(0, 3), 0), 30)
                value: dict[str, Any] = {"v": round(v, 2), "on": v > 12, "gear": chance.choice("NDR")}
                if chance.random() < 0.02:
                    value = chance.choice([{"v": None}, {}, {"v": "fast", "on": 1}])
                found.append((T0 + int(at * 10) * SECOND // 10 + car * (car > 1), f"cars/car{car}/{stream}", value))
                at += chance.choice([1, 1, 1, 2]) / hertz
    return iter(sorted(found, key=lambda each: each[0]))


def write(path: Path, chance: random.Random, seconds: int) -> None:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2048)
        writer.start()
        channels: dict[str, int] = {}
        for time, key, value in messages(chance, seconds):
            if key not in channels:
                channels[key] = writer.register_channel(f"/{key}", "json", 0)
            writer.add_message(channels[key], time, json.dumps(value).encode(), time)
        writer.finish()  # type: ignore[no-untyped-call]


def detector_of(chance: random.Random) -> Detector:
    streams = [a_stream(name, key=f"cars/${{client:*}}/{name}") for name in ("odom", "slow")]
    return a_detector(*streams, clientTimeout=chance.choice(["4s", "12s"]), buffer={"duration": "5s"})


SIGNALS = {
    "v": {"stream": "odom", "value": "msg.v"},
    "on": {"stream": "odom", "value": "msg.on"},
    "gear": {"stream": "slow", "value": "msg.gear"},
    "low": {"stream": "odom", "value": "msg.v", "over": "3s", "aggregate": "Min"},
    "mean": {"stream": "slow", "value": "msg.v", "over": "5s", "aggregate": "Mean"},
    "count": {"stream": "odom", "over": "2s", "aggregate": "Count"},
    "before": {"stream": "slow", "value": "msg.v", "aggregate": "Previous"},
    "spread": {"stream": "odom", "value": "msg.v", "over": "1s", "aggregate": "StdDev"},
    "jump": {"stream": "odom", "value": "msg.v - before.v", "over": "3s", "aggregate": "Max"},
    "often": {"stream": "odom", "value": "msg.on", "over": "2s", "aggregate": "Any", "where": "msg.v > 5"},
}
CONDITIONS = [
    "v > 15", "v < 10 || on", "gear == 'R'", "low > 8", "mean < 14 && v > 3", "count < 12", "v - before > 4",
    "spread > 2", "jump > 6", "often && gear != 'N'", "on", "'slow' in streams && v > 10",
]  # fmt: skip


def rule_of(chance: random.Random, name: str) -> EventRule:
    spec: dict[str, Any] = {
        "evaluation": {"every": chance.choice(["100ms", "300ms", "1s", "7s"])},
        "signals": [{"name": name, **signal} for name, signal in SIGNALS.items()],
        "when": chance.choice(CONDITIONS),
        "for": chance.choice(["0s", "0s", "500ms", "3s", "20s"]),
        "cooldown": chance.choice(["0s", "0s", "2s", "40s"]),
        "unknownTimeout": chance.choice(["1s", "10s", "60s"]),
    }
    if chance.random() < 0.6:
        spec["until"] = chance.choice(CONDITIONS)
    if chance.random() < 0.3:
        spec["scope"] = {"client": {"where": "client != 'car1' && 'slow' in streams"}}
    return a_rule(name, **spec)


def cut(job: MiningJob, spans: list[PieceTimes]) -> RecordingResult:
    pieces = [observe(PieceJob(span, job.source.files, job.detector, job.rules)) for span in spans]
    assert flaw_of(pieces) is None
    return joined(job, tuple(map(Path, job.source.files)), pieces)


@pytest.mark.parametrize("seed", range(6))
def test_a_cut_recording_has_the_episodes_of_the_whole_one(seed: int, tmp_path: Path) -> None:
    chance = random.Random(seed)
    seconds = chance.randrange(60, 180)
    write(tmp_path / "drive.mcap", chance, seconds)
    detector = detector_of(chance)
    rules = [rule_of(chance, f"rule-{number}") for number in range(6)]
    source = InputRecording("drive.mcap", (str(tmp_path / "drive.mcap"),))
    job = MiningJob(source, "c" * 32, detector, rules, frozenset(rule.name for rule in rules), None)
    compiled, refused = RuleIndex().compile(rules, detector, stream_readers(detector).fields)
    assert not refused
    cuts = sorted({T0 + chance.randrange(seconds * 10) * SECOND // 10 + chance.randrange(3) for _ in range(4)})
    warmup = warmup_of(detector, compiled)
    spans = [PieceTimes(max(after - warmup, 0), after, until) for after, until in pairwise([START, *cuts, END])]
    whole, found = decode_mined(mine_recording(job)), cut(job, spans)
    assert not whole.flaws
    assert len(whole.episodes) > 0
    assert found.episodes == whole.episodes
    assert (found.counts, found.streams) == (whole.counts, whole.streams)
    assert (found.samples, found.begin, found.end) == (whole.samples, whole.begin, whole.end)
