"""An hour of traffic through a `detector run` process, much faster than its own speed: does anything grow or go wrong?

The detector runs all rules of the cooperative-recording example and one of every kind that there is, with `clock:
Data`. Fifteen vehicles send poses, point clouds and telemetry over Zenoh, and once a minute each kind of what must be
dropped.
While it runs its metrics are read every second; at the end all of them are compared with what was sent:

- memory: after the first sixth of the time it does not grow;
- drops: each cause exactly as often as it was provoked, and no other;
- every metric: samples, evaluations, episodes (with events.jsonl), ages, states, histograms.

    python -m benchmarks.soak [--minutes 60] [--speed 6] [--replay] [--output FOLDER]

`--replay` records what the detector takes in, and replays it: the events must be the same, byte by byte.
The exit code is 1 where any of this fails.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import yaml
import zenoh
from onnx import TensorProto, helper, numpy_helper
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.soaking.traffic import EXAMPLE, FLUSH, Sent, traffic

SOAKING = Path(__file__).parent / "soaking"
START = 1_767_225_600_000_000_000
SEED = 3528
PATIENCE = 120.0
"""Seconds in which the detector must have evaluated the rest."""

AHEAD = 90.0
"""Seconds of the data's time that the traffic may be ahead of the evaluation."""

GROWTH, SLACK = 0.05, 8 * 2**20
"""How much memory may differ between the second sixth and the last, for noise: this share, or these bytes."""

Metrics = dict[tuple[str, ...], float]
"""Values by name without prefix and the labels' values in the order of their names."""


class Detector:
    """The process under test, and its metrics over time."""

    def __init__(self, folder: Path, record: bool) -> None:
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.port = free_port()
        self.series: list[tuple[float, float, float]] = []
        """Seconds of the wall, seconds of the data evaluated, bytes of memory."""
        detector = (SOAKING / "detector.yaml").read_text().replace("ENDPOINT", self.endpoint)
        (folder / "detector.yaml").write_text(detector)
        rules = (SOAKING / "rules.yaml").read_text().replace("MODEL", str(a_model(folder / "smooth.onnx")))
        (folder / "rules.yaml").write_text(rules)
        self.files = ["--detector", "detector.yaml", "--rules", "rules.yaml", "--rules", str(EXAMPLE / "rules.yaml")]
        recording = ["--record-intake", "intake.mcap"] if record else []
        self.process = subprocess.Popen(
            [sys.executable, "-m", "detector.cli", "run", *self.files, "--metrics-port", str(self.port), *recording],
            cwd=folder,
            stderr=(folder / "log").open("w"),
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])},
        )
        self._begun = time.monotonic()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def await_start(self) -> None:
        end = time.monotonic() + 60
        while time.monotonic() < end:
            if self.process.poll() is not None:
                break
            try:
                if self.metrics():
                    self._thread.start()
                    return
            except OSError:
                time.sleep(0.1)
        sys.exit(f"the detector does not start:\n{(self.folder / 'log').read_text()}")

    def metrics(self) -> Metrics:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/metrics", timeout=30) as answer:
            text = answer.read().decode()
        return {
            (sample.name.removeprefix("wayside_detector_"), *(sample.labels[name] for name in sorted(sample.labels))):
                sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
        }  # fmt: skip

    @property
    def evaluated(self) -> float:
        """Seconds of the data that have been evaluated, as far as is known."""
        return self.series[-1][1] if self.series else 0.0

    def rest(self, until: float) -> Metrics:
        """The metrics once the data has been evaluated up to there."""
        end = time.monotonic() + PATIENCE
        while self.evaluated < until:
            if time.monotonic() > end or self.process.poll() is not None:
                print(f"evaluated only up to {self.evaluated:.1f} s of {until:.1f} s")
                break
            time.sleep(0.2)
        time.sleep(1.5)  # the status is taken once a second: the next one has all of it
        return self.metrics()

    def end(self) -> int:
        self._stop.set()
        self._thread.join()
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(60)

    def _watch(self) -> None:
        while not self._stop.wait(1.0):
            try:
                found = self.metrics()
            except OSError:
                return
            evaluated = max(0.0, found["evaluated_time_seconds",] - START / 1e9)
            if evaluated < 10**7:  # before the first stamp, the wall's time stands for it
                wall = time.monotonic() - self._begun
                self.series.append((wall, evaluated, found["process_resident_memory_bytes",]))


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=int, default=60, help="of the data's time")
    parser.add_argument("--speed", type=float, default=6.0, help="times as fast as it happens, at most")
    parser.add_argument("--replay", action="store_true", help="record, replay, and compare the events")
    parser.add_argument("--output", type=Path, help="keep everything in this folder, with memory.csv")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if options.output is None else options.output.resolve()
        folder.mkdir(parents=True, exist_ok=True)
        sys.exit(soak(folder, options.minutes * 60, options.speed, options.replay))


def soak(folder: Path, seconds: int, speed: float, replay: bool) -> int:
    detector = Detector(folder, replay)
    detector.await_start()
    sent = Sent()
    begun = time.monotonic()
    try:
        asked = send(detector, seconds, speed, sent)
        wall = time.monotonic() - begun
        metrics = detector.rest(seconds + FLUSH - 6)  # lateness is 5 s
    finally:
        code = detector.end()
    total = sum(sent.samples.values())
    print(f"{total} samples of {seconds} s in {wall:.0f} s: {seconds / wall:.1f} times as fast, {total / wall:.0f}/s")
    verdict = Verdict()
    verdict.equal("the detector's exit code", code, 0)
    look_at_memory(verdict, detector.series, seconds, folder)
    look_at_drops(verdict, metrics, sent)
    look_at_streams(verdict, metrics, sent)
    look_at_rules(verdict, metrics, detector, seconds, sent, asked)
    if replay:
        look_at_replay(verdict, detector)
    for text in verdict.wrong:
        print(f"WRONG: {text}")
    print(
        f"{verdict.looked_at} things looked at, {len(verdict.wrong)} wrong: {'FAILED' if verdict.wrong else 'passed'}"
    )
    return 1 if verdict.wrong else 0


def send(detector: Detector, seconds: int, speed: float, sent: Sent) -> int:
    """Publish the traffic, at most so much faster than it happens, and never far ahead of the evaluation.

    Once a minute the rule on-demand is asked; returns how often it answered.
    """
    asked, answered = 0, 0
    config = zenoh.Config()
    for key, value in (
        ("mode", '"client"'),
        ("connect/endpoints", json.dumps([detector.endpoint])),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(key, value)
    with zenoh.open(config) as session:
        publishers: dict[str, Any] = {}
        begun, told = time.monotonic(), time.monotonic()
        for after, key, payload in traffic(SEED, START, seconds, sent):
            due = begun + after / 1e9 / speed
            while (early := due - time.monotonic()) > 0.005 or after / 1e9 - detector.evaluated > AHEAD:
                if detector.process.poll() is not None:
                    sys.exit(f"the detector ended:\n{(detector.folder / 'log').read_text()[-2000:]}")
                time.sleep(min(max(early, 0.005), 0.1))
            publisher = publishers.get(key)
            if publisher is None:
                publisher = publishers[key] = session.declare_publisher(
                    key, congestion_control=zenoh.CongestionControl.BLOCK
                )
            publisher.put(payload)
            if after >= asked * 60 * 10**9 + 30 * 10**9:
                asked += 1
                question = "wayside/detectors/soak/evaluate?rule=on-demand"
                answered += sum(reply.ok is not None for reply in session.get(question, timeout=30))
            if time.monotonic() - told > 15:
                told = time.monotonic()
                memory = detector.series[-1][2] / 2**20 if detector.series else 0
                print(f"  {after / 6e10:.1f} min sent, {detector.evaluated / 60:.1f} min evaluated, {memory:.1f} MiB")
        time.sleep(1.0)  # what is batched goes out
    return answered


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
    explained = {
        key: value
        for key, value in found.items()
        if key[0] in ("skipped", "suppressed") or (key[0] == "error" and key[1] in TIMED)
    }
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
    for stream in ("pose", "points", "telemetry", "status"):
        verdict.equal(f"samples of {stream}", metrics["stream_samples_total", stream], sent.samples[stream])
        verdict.true(f"{stream} has latencies", metrics["stream_latency_seconds_count", stream] > 0)
        verdict.equal(f"age of {stream}", metrics["stream_age_seconds", stream], FLUSH - 5, 2)
        verdict.true(f"{stream} is buffered", metrics["stream_buffered_samples", stream] > 0)
    for key, value in metrics.items():
        buffered += value if key[0] == "stream_buffered_bytes" else 0
    verdict.equal("the buffer's bytes", metrics["buffer_bytes",], buffered)
    verdict.true("the buffer keeps to its cap", buffered <= metrics["buffer_limit_bytes",])
    verdict.equal("clients", metrics["clients",], 17)  # fifteen vehicles, the expected station, and the clock
    verdict.equal("gaps", metrics["gaps_total",], 0)


def look_at_rules(verdict: Verdict, metrics: Metrics, detector: Detector, seconds: int, sent: Sent, asked: int) -> None:
    started: Counter[str] = Counter()
    ended: Counter[str] = Counter()
    for line in (detector.folder / "out" / "events.jsonl").read_text().splitlines():
        event = json.loads(line)
        (started if event["type"].endswith("started") else ended)[event["data"]["rule"]] += 1
    documents = [
        *yaml.safe_load_all((detector.folder / "rules.yaml").read_text()),
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
        if name not in TIMED:
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
            verdict.equal(f"answers of {name}", asked, seconds // 60)
        quiet = {"that-is-disabled", *TIMED, *QUIET}
        verdict.true(f"{name} has episodes", started[name] > 0 or name in quiet or seconds < 600)


TIMED = ("with-a-plugin",)
"""Rules whose plugin has a time limit of the wall, which a busy machine may not keep: then it is an error, and said."""

QUIET: tuple[str, ...] = ()
"""Rules of which no episode is expected."""


def look_at_replay(verdict: Verdict, detector: Detector) -> None:
    command = [sys.executable, "-m", "detector.cli", "replay", "intake.mcap", "--output", "replayed"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    done = subprocess.run(command, cwd=detector.folder, env=environment, capture_output=True, text=True, check=False)
    verdict.equal("the replay's exit code", done.returncode, 0)
    live, replayed = (detector.folder / folder / "events.jsonl" for folder in ("out", "replayed"))
    same = replayed.exists() and live.read_bytes() == replayed.read_bytes()
    verdict.true("the replay gives the same events, byte by byte", same)


def seconds_of(duration: str) -> float:
    for unit, factor in (("ms", 0.001), ("s", 1.0), ("m", 60.0)):
        if duration.endswith(unit):
            return float(duration.removesuffix(unit)) * factor
    raise ValueError(duration)


def a_model(path: Path) -> Path:
    """The mean of ten values."""
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["y"])],
        "mean",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 10])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", 1])],
        [numpy_helper.from_array(np.full((10, 1), 0.1, np.float32), "w")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, path)
    return path


def free_port() -> int:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    main()
