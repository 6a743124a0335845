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
from contextlib import closing
from pathlib import Path
from typing import Any

import zenoh
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.soaking.judging import (
    Metrics,
    Verdict,
    look_at_drops,
    look_at_memory,
    look_at_replay,
    look_at_rules,
    look_at_streams,
)
from benchmarks.soaking.traffic import (
    EXAMPLE,
    FLUSH,
    LATENESS,
    OVER_MQTT,
    SIDE,
    START,
    VEHICLES,
    Sent,
    traffic,
)
from tests.onnx_models import mean_of, weighted
from tests.process.mqtt_broker import broker, publisher

SOAKING = Path(__file__).parent / "soaking"
SEED = 3528
PATIENCE = 120.0
"""Seconds in which the detector must have evaluated the rest."""

SETTLED = 5.0
"""Seconds after which a task that has ended is nobody's business any more."""

AHEAD = 90.0
"""Seconds of the data's time that the traffic may be ahead of the evaluation."""


class Detector:
    """The process under test, and its metrics over time."""

    def __init__(self, folder: Path, broker_port: int, record: bool) -> None:
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.port = free_port()
        self.series: list[tuple[float, float, float]] = []
        """Seconds of the wall, seconds of the data evaluated, bytes of memory."""
        detector = (SOAKING / "detector.yaml").read_text().replace("ENDPOINT", self.endpoint)
        (folder / "detector.yaml").write_text(detector.replace("MQTT_PORT", str(broker_port)))
        rules = (SOAKING / "rules.yaml").read_text()
        for place, model in (
            ("CAMERA_MODEL", mean_of(folder / "camera.onnx", [1, SIDE, SIDE])),
            ("LIDAR_MODEL", mean_of(folder / "lidar.onnx", [64, 3])),
            ("MODEL", weighted(folder / "smooth.onnx", [0.1] * 10)),
        ):
            rules = rules.replace(place, str(model))
        (folder / "rules.yaml").write_text(rules)
        self.files = ["--detector", "detector.yaml", "--rules", "rules.yaml", "--rules", str(EXAMPLE / "rules.yaml")]
        recording = ["--record-intake", "intake.mcap"] if record else []
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "detector.commands.cli",
                "run",
                *self.files,
                "--metrics-port",
                str(self.port),
                *recording,
            ],
            cwd=folder,
            stderr=(folder / "log").open("w"),
            env=environment(),
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
            self._remove_ended_tasks()

    def _remove_ended_tasks(self) -> None:
        """What the manager does an hour after their end: without one, the files stay, and the detector knows them."""
        for file in (self.folder / "out" / "tasks").glob("[!.]*.yaml"):
            if time.time() - file.stat().st_mtime > SETTLED and "endTime:" in file.read_text():
                file.unlink()


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
        port = free_port()
        with broker(port):
            sys.exit(soak(folder, port, options.minutes * 60, options.speed, options.replay))


def soak(folder: Path, broker_port: int, seconds: int, speed: float, replay: bool) -> int:
    detector = Detector(folder, broker_port, replay)
    detector.await_start()
    sent = Sent()
    begun = time.monotonic()
    try:
        requested = send(detector, broker_port, seconds, speed, sent)
        wall = time.monotonic() - begun
        metrics = detector.rest(seconds + FLUSH - LATENESS - 1)
    finally:
        code = detector.end()
    total = sum(sent.samples.values())
    print(f"{total} samples of {seconds} s in {wall:.0f} s: {seconds / wall:.1f} times as fast, {total / wall:.0f}/s")
    verdict = Verdict()
    verdict.equal("the detector's exit code", code, 0)
    look_at_memory(verdict, detector.series, seconds, folder)
    look_at_drops(verdict, metrics, sent)
    look_at_streams(verdict, metrics, sent)
    look_at_rules(verdict, metrics, folder, seconds, sent, requested)
    if replay:
        look_at_replay(verdict, folder, environment())
    for text in verdict.wrong:
        print(f"WRONG: {text}")
    print(
        f"{verdict.looked_at} things looked at, {len(verdict.wrong)} wrong: {'FAILED' if verdict.wrong else 'passed'}"
    )
    return 1 if verdict.wrong else 0


def send(detector: Detector, broker_port: int, seconds: int, speed: float, sent: Sent) -> int:
    """Publish the traffic, at most by this factor faster than real time, and never far ahead of the evaluation.

    Once a minute the rule on-demand is evaluated, and the token of a vehicle is withdrawn for a moment. Returns how
    often the rule answered.
    """
    requested, answered = 0, 0
    config = zenoh.Config()
    for key, value in (
        ("mode", '"client"'),
        ("connect/endpoints", json.dumps([detector.endpoint])),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(key, value)
    with zenoh.open(config) as session, publisher(broker_port) as over_mqtt:
        publishers: dict[str, Any] = {}
        tokens = {vehicle.name: Token(session, vehicle.name) for vehicle in VEHICLES}
        begun, reported = time.monotonic(), time.monotonic()
        for after, key, payload in traffic(SEED, START, seconds, sent):
            due = begun + after / 1e9 / speed
            while (early := due - time.monotonic()) > 0.005 or after / 1e9 - detector.evaluated > AHEAD:
                if detector.process.poll() is not None:
                    sys.exit(f"the detector ended:\n{(detector.folder / 'log').read_text()[-2000:]}")
                time.sleep(min(max(early, 0.005), 0.1))
            if key.endswith(OVER_MQTT):
                over_mqtt.publish(key, payload, qos=1)
            else:
                if key not in publishers:
                    publishers[key] = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
                publishers[key].put(payload)
            tokens[VEHICLES[0].name].keep()
            if after >= requested * 60 * 10**9 + 30 * 10**9:
                requested += 1
                question = "wayside/detectors/soak/evaluate?rule=on-demand"
                tokens[VEHICLES[0].name].withdraw()
                answered += sum(reply.ok is not None for reply in session.get(question, timeout=30))
            if time.monotonic() - reported > 15:
                reported = time.monotonic()
                memory = detector.series[-1][2] / 2**20 if detector.series else 0
                print(f"  {after / 6e10:.1f} min sent, {detector.evaluated / 60:.1f} min evaluated, {memory:.1f} MiB")
        time.sleep(1.0)  # what is batched goes out
    return answered


class Token:
    """A vehicle's liveliness token."""

    def __init__(self, session: zenoh.Session, client: str) -> None:
        self._declare = lambda: session.liveliness().declare_token(f"alive/{client}")
        self._token: zenoh.LivelinessToken | None = self._declare()
        self._withdrawn = 0.0

    def withdraw(self) -> None:
        if self._token is not None:
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._token, self._withdrawn = None, time.monotonic()

    def keep(self) -> None:
        """Declare it again, a second after it was withdrawn."""
        if self._token is None and time.monotonic() - self._withdrawn > 1.0:
            self._token = self._declare()


def environment() -> dict[str, str]:
    """With which our own modules are found."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}


def free_port() -> int:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    main()
