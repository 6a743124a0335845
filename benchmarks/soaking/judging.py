"""The verdict of a soak run: memory, drops, streams, rules and the replay, compared with the sent messages."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from benchmarks.soaking.traffic import EXAMPLE, FLUSH, LATENESS, OVER_MQTT, START, Sent

GROWTH, SLACK = 0.02, 3 * 2**20
"""How much memory may differ between the second sixth and the last, for noise: this share, or these bytes."""

Metrics = dict[tuple[str, ...], float]
"""Values by name without prefix and the labels' values in the order of their names."""


class Verdict:
    """What was looked at, and what was wrong with it."""

    def __init__(self) -> None:
        self.wrong: list[str] = []
        self.looked_at = 0

    def equal(self, what: str, found: float, wanted: float, tolerance: float = 0.0) -> None:
        self.true(f"{what} is {found:g}, should be {wanted:g}", abs(found - wanted) <= tolerance)

    def true(self, what: str, holds: bool) -> None:
        self.looked_at += 1
        if not holds:
            self.wrong.append(what)


def look_at_memory(verdict: Verdict, series: list[tuple[float, float, float]], seconds: int, folder: Path) -> None:
    lines = ["wall_s,data_s,memory_bytes", *(f"{wall:.1f},{data:.1f},{memory:.0f}" for wall, data, memory in series)]
    (folder / "memory.csv").write_text("\n".join(lines) + "\n")
    sixth = seconds / 6
    medians = []
    for part in range(6):
        within = [memory for _, data, memory in series if part * sixth <= data < (part + 1) * sixth]
        medians.append(float(np.median(within)) if within else float("nan"))
    print("memory by sixths of the time, MiB: " + ", ".join(f"{median / 2**20:.1f}" for median in medians))
    growth = medians[5] - medians[1]
    allowed = max(GROWTH * medians[1], SLACK)
    text = f"memory grew by {growth / 2**20:.1f} MiB from the second sixth to the last, more than {allowed / 2**20:.1f}"
    verdict.true(text, growth <= allowed)


def look_at_drops(verdict: Verdict, metrics: Metrics, sent: Sent) -> None:
    found = Counter({key[1:]: value for key, value in metrics.items() if key[0] == "losses_total" and value})
    wanted: dict[tuple[str, ...], float] = {
        (cause, "", stream): count for (cause, stream), count in sent.dropped.items()
    }
    # Faster than its own speed, a machine may be too slow; `look_at_rules` accounts for what is left out then.
    explained = {key: value for key, value in found.items() if key[0] in ("skipped", "suppressed")}
    wanted |= explained
    for key in sorted({*found, *wanted}):
        cause, rule, stream = key
        verdict.equal(f"losses of cause {cause} {stream or rule}".strip(), found[key], wanted.get(key, 0))
    provoked = sorted(wanted.keys() - explained.keys())
    print("dropped as provoked: " + ", ".join(f"{found[key]:.0f} {key[0]}" for key in provoked))
    for key, count in sorted(explained.items()):
        print(f"  explained, the traffic being faster than its own speed: {count:.0f} {key[0]} of {key[1]}")


def look_at_streams(verdict: Verdict, metrics: Metrics, sent: Sent) -> None:
    buffered = 0.0
    for stream in ("pose", "points", "telemetry", "status", OVER_MQTT, "camera"):
        verdict.equal(f"samples of {stream}", metrics["stream_samples_total", stream], sent.samples[stream])
        verdict.true(f"{stream} has latencies", metrics["stream_latency_seconds_count", stream] > 0)
        verdict.equal(f"age of {stream}", metrics["stream_age_seconds", stream], FLUSH - LATENESS, 2)
        verdict.true(f"{stream} is buffered", metrics["stream_buffered_samples", stream] > 0)
    for key, value in metrics.items():
        buffered += value if key[0] == "stream_buffered_bytes" else 0
    verdict.equal("the buffer's bytes", metrics["buffer_bytes",], buffered)
    verdict.true("the buffer keeps to its cap", buffered <= metrics["buffer_limit_bytes",])
    verdict.equal("clients", metrics["clients",], 17)  # fifteen vehicles, the expected station, and the clock
    verdict.equal("gaps", metrics["gaps_total",], 0)


def look_at_rules(verdict: Verdict, metrics: Metrics, folder: Path, seconds: int, sent: Sent, requested: int) -> None:
    started: Counter[str] = Counter()
    ended: Counter[str] = Counter()
    lost = 0
    for line in (folder / "out" / "events.jsonl").read_text().splitlines():
        event = json.loads(line)
        (started if event["type"].endswith("started") else ended)[event["data"]["rule"]] += 1
        lost += event["data"].get("reason") == "ClientLost"
    verdict.true("episodes ended with a vehicle's token", lost > 0 or seconds < 600)
    documents = [
        *yaml.safe_load_all((folder / "rules.yaml").read_text()),
        *yaml.safe_load_all((EXAMPLE / "rules.yaml").read_text()),
    ]
    evaluated = metrics["evaluated_time_seconds",] - START / 1e9
    for rule in documents:
        name, spec = rule["metadata"]["name"], rule["spec"]
        enabled = spec.get("enabled", True)
        left_out = metrics.get(("losses_total", "skipped", name, ""), 0)
        states = ["Accepted", "Degraded"] if enabled else ["Disabled"]
        verdict.equal(f"{name} is {states[0]}", sum(metrics["rule_state", name, state] for state in states), 1)
        verdict.equal(f"episodes started of {name}", metrics["rule_episodes_started_total", name], started[name])
        verdict.equal(f"episodes ended of {name}", metrics["rule_episodes_ended_total", name], ended[name])
        open_now = metrics["rule_episodes_open", name]
        verdict.equal(f"episodes open of {name}", open_now, started[name] - ended[name])
        verdict.equal(f"errors of {name}", metrics["rule_errors_total", name], 0)
        evaluation = spec.get("evaluation", {})
        if enabled and set(evaluation) <= {"every"}:
            every = seconds_of(evaluation.get("every", "1s"))
            verdict.equal(f"ticks of {name}", metrics["rule_ticks_total", name] + left_out, evaluated // every, 1)
            verdict.true(f"{name} was evaluated", metrics["rule_evaluations_total", name] > 0)
        spent = metrics["rule_evaluation_seconds_total", name]
        print(f"  {name}: {metrics['rule_evaluations_total', name]:.0f} evaluations in {spent:.1f} s, "
            f"{started[name]} episodes, {metrics['rule_unknowns_total', name]:.0f} unknowns")  # fmt: skip
        if "onSample" in evaluation:
            text = f"{name} was evaluated with each sample, or when a time was over"
            evaluations = metrics["rule_evaluations_total", name]
            verdict.true(text, bool(left_out) or evaluations >= sent.samples[evaluation["onSample"]])
        if "maxEpisodesPerHour" in spec:
            suppressed = metrics.get(("losses_total", "suppressed", name, ""), 0)
            verdict.true(f"{name} suppressed episodes", suppressed > 0 or seconds < 1800)
        if evaluation.get("onDemand"):
            verdict.equal(f"answers of {name}", requested, seconds // 60)
        quiet = {"that-is-disabled", *QUIET}
        verdict.true(f"{name} has episodes", started[name] > 0 or name in quiet or seconds < 600)


QUIET: tuple[str, ...] = ()
"""Rules of which no episode is expected."""


def look_at_replay(verdict: Verdict, folder: Path, environment: Mapping[str, str]) -> None:
    command = [sys.executable, "-m", "detector.commands.cli", "replay", "intake.mcap", "--output", "replayed"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    verdict.equal("the replay's exit code", done.returncode, 0)
    live, replayed = (folder / each / "events.jsonl" for each in ("out", "replayed"))
    same = replayed.exists() and live.read_bytes() == replayed.read_bytes()
    verdict.true("the replay gives the same events, byte by byte", same)


def seconds_of(duration: str) -> float:
    for unit, factor in (("ms", 0.001), ("s", 1.0), ("m", 60.0)):
        if duration.endswith(unit):
            return float(duration.removesuffix(unit)) * factor
    raise ValueError(duration)
