"""`detector run` with one vehicle and 50 rules: how soon an event follows its sample, and its share of a core.

Latency: from the put of a sample until the event that it starts or ends is received, with 50 rules onSample, of which
one changes with every sample. The baseline in turn with it: a Python process whose callback puts a message as soon as
one comes. CPU: the share of a core with the maximum of the last 1 to 5 s at 10 Hz, evaluated every 100 ms, and beside
it that of a subscriber which does nothing. Exits with 1 where the CPU misses its target.

    python -m benchmarks.live_program [--samples 1000] [--hz 50] [--rules 50] [--seconds 20]
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import queue
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
import zenoh

from benchmarks.intake_rate import settings
from benchmarks.sidecar_cost import Cost, cost
from benchmarks.workloads import speeds
from tests.ports import free_endpoint

TARGET_CPU = 0.03
PATIENCE = 30.0  # s
MISSING = 1.0  # s; on a machine that is too slow, the detector leaves out evaluations
KEY, ECHO, EVENTS = "vehicles/c0/speed", "echo/c0", "wayside/events/**"
FLIP = "flip"
HIGH, LOW = b'{"speed": 100.0}', b'{"speed": 1.0}'
BARE = """
import sys, threading, zenoh
from benchmarks.intake_rate import settings
with zenoh.open(settings(listen__endpoints=[sys.argv[1]])) as session:
    def answer(sample):
        if sys.argv[2]:
            session.put(sys.argv[2], sample.payload, express=True)
    subscriber = session.declare_subscriber("vehicles/*/speed", answer)
    threading.Event().wait()
"""


def main() -> int:
    """Measure and print; 1 means that a target was missed."""
    parser = argparse.ArgumentParser(prog="live_program", description=__doc__)
    parser.add_argument("--samples", type=int, default=1000, help="whose latency is measured (%(default)s)")
    parser.add_argument("--hz", type=float, default=50.0, help="at which they are sent (%(default)g)")
    parser.add_argument("--rules", type=int, default=50, help="(%(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the measurement of CPU (%(default)g)")
    options = parser.parse_args()
    on_sample = [speeds.rule_document(each, {"onSample": "speed"}) for each in speeds.limits(options.rules - 1)]
    part = options.samples // 2
    bare, ours = [], []
    for _ in range(2):
        with receiver(None, answers=True) as (_, session):
            bare += latencies(session, ECHO, part, options.hz)
        with receiver([flip(), *on_sample]) as (_, session):
            ours += latencies(session, EVENTS, part, options.hz)
    for name, found in (("bare round trip", bare), ("sample to event", ours)):
        print(f"{name}: median {statistics.median(found):.2f} ms, p99 {p99(found):.2f} ms, worst {max(found):.2f} ms")
    print(
        f"{options.rules} rules onSample: p99 is {p99(ours) - p99(bare):.2f} ms more than that of the bare round trip"
    )
    every = [speeds.rule_document(each, {"every": "100ms"}) for each in speeds.limits(options.rules)]
    with receiver(None) as (pid, session):
        least = under_load(pid, session, options.seconds)
    with receiver(every) as (pid, session):
        used = under_load(pid, session, options.seconds)
    print(
        f"{options.rules} rules every 100 ms, one vehicle at 10 Hz: {used.cpu:.1%} of a core "
        f"(bare subscriber {least.cpu:.1%}; target {TARGET_CPU:.0%})"
    )
    return int(used.cpu > TARGET_CPU)


def p99(found: Sequence[float]) -> float:
    """Of 100 equal parts, the beginning of the last."""
    return statistics.quantiles(found, n=100)[-1]


def flip() -> dict[str, Any]:
    """A rule whose episodes begin and end with every second sample."""
    rule = speeds.rule_document(speeds.limits(1)[0], {"onSample": "speed"})
    rule["metadata"]["name"] = FLIP
    signals = [{"name": "speed", "stream": "speed", "value": "msg.speed"}]
    rule["spec"] |= {"signals": signals, "when": "speed > 50", "until": "speed < 50"}
    return rule


@contextlib.contextmanager
def receiver(rules: Sequence[dict[str, Any]] | None, *, answers: bool = False) -> Iterator[tuple[int, zenoh.Session]]:
    """The pid of `detector run` with these rules (None: of a bare subscriber), and a session connected to it."""
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as name, (Path(name) / "log").open("w+", encoding="utf-8") as log:
        folder = Path(name)
        if rules is None:
            command = [sys.executable, "-c", BARE, endpoint, ECHO if answers else ""]
        else:
            document = speeds.detector_document()
            document["spec"]["zenoh"] = {"mode": "peer", "listen": [endpoint], "scouting": False}
            (folder / "detector.yaml").write_text(yaml.safe_dump(document))
            (folder / "rules.yaml").write_text(yaml.safe_dump_all(rules))
            command = [sys.executable, "-m", "detector.commands.cli", "run", f"--detector={folder / 'detector.yaml'}"]
            command += [f"--rules={folder / 'rules.yaml'}", f"--output={folder / 'out'}"]
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            config = settings(connect__endpoints=[endpoint], connect__timeout_ms=20_000, listen__endpoints=[])
            with zenoh.open(config) as session:
                wait_for_subscriber(session)
                yield process.pid, session
        finally:
            process.kill()
            process.wait()


def wait_for_subscriber(session: zenoh.Session) -> None:
    """Return once somebody listens to the vehicle. Raises TimeoutError."""
    deadline = time.monotonic() + PATIENCE
    with session.declare_publisher(KEY) as publisher:
        while not publisher.matching_status.matching:
            if time.monotonic() > deadline:
                raise TimeoutError(f"nobody subscribed to {KEY} within {PATIENCE:g} s")
            time.sleep(0.01)


def latencies(session: zenoh.Session, answers: str, samples: int, hz: float) -> list[float]:
    """Milliseconds from each sample to its answer, of samples at this rate; the first second does not count."""
    came: queue.SimpleQueue[float] = queue.SimpleQueue()

    def receive(sample: zenoh.Sample) -> None:
        if FLIP in str(sample.key_expr) or answers == ECHO:
            came.put(time.perf_counter())

    found = []
    with session.declare_subscriber(answers, receive):
        payloads, begin = itertools.cycle((HIGH, LOW)), time.perf_counter()
        for number in range(samples + round(hz)):
            time.sleep(max(0.0, begin + number / hz - time.perf_counter()))
            sent = time.perf_counter()
            session.put(KEY, next(payloads), express=True)
            with contextlib.suppress(queue.Empty):
                found.append((came.get(timeout=MISSING) - sent) * 1e3)
    if len(found) < 0.9 * samples:
        raise SystemExit(f"of {samples + round(hz)} samples {len(found)} were answered: the machine is too busy")
    return found[round(hz) :]


def under_load(pid: int, session: zenoh.Session, seconds: float) -> Cost:
    """What the process takes while one vehicle sends at 10 Hz; the windows are full before."""
    over = threading.Event()

    def send() -> None:
        for payload in speeds.arrivals(1, 10, 10**6):
            if over.wait(0.1):
                return
            session.put(KEY, payload.payload)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        time.sleep(speeds.LONGEST + 1)
        return cost(pid, seconds)
    finally:
        over.set()
        sender.join()


if __name__ == "__main__":
    sys.exit(main())
