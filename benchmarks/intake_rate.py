"""How many samples a second `detector run` takes from Zenoh into its buffer, beside a callback that only counts.

Publishers are processes of their own. They send the speeds of 100 clients as fast as they can with congestion control
BLOCK, so nothing is dropped on the way and what they send is what the receiver takes. Receivers alternate: a bare
zenoh-python subscriber whose callback counts, and the program `detector run` with 50 rules over the maximum of the last
1 to 5 s, evaluated every 100 ms. A rate counts up to the last sample that the receiver has: for the detector, that is
in its buffer. A run where a sample is lost does not count; evaluations that were left out are printed.

The table of stages gives the CPU time of the detector's threads for each message, measured in the same runs around
batches, never around single messages.

    python -m benchmarks.intake_rate [--rounds 5] [--seconds 8] [--publishers 1 2] [--rules 50] [--clients 100]
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
import zenoh

from benchmarks.workloads import speeds
from tests.ports import free_endpoint

TARGETS = {1: 0.9, 2: 0.6}
"""By number of publishers: the target as a fraction of the bare callback's rate."""

PATIENCE = 30.0  # s until a publisher gives up on its subscriber
PHASES = 1024
"""The number of payloads in which a client's speed rises and falls once."""
BARE, DETECTOR = "bare", "detector"
MARK = "benchmark: "
"""The prefix of the line of standard error with a receiver's report."""


class Run(NamedTuple):
    """The result of one receiver."""

    rate: float
    """Samples a second."""
    count: int
    report: Mapping[str, Any]
    """The receiver's measurements."""


def main() -> int:
    """Measure and print; 1 means that a target was missed."""
    parser = argparse.ArgumentParser(
        prog="intake_rate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5, help="of each receiver (%(default)s)")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run (%(default)g)")
    parser.add_argument("--publishers", type=int, nargs="+", default=[1, 2], help="processes (1 2)")
    parser.add_argument("--rules", type=int, default=50, help="(%(default)s)")
    parser.add_argument("--clients", type=int, default=100, help="(%(default)s)")
    parser.add_argument("--role", choices=["publisher", BARE], help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    parser.add_argument("--share", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == "publisher":
        publish(options.endpoint, options.seconds, range(options.clients)[options.share[0] :: options.share[1]])
        return 0
    if options.role == BARE:
        count(options.endpoint)
        return 0
    missed = False
    for publishers in options.publishers:
        runs: dict[str, list[Run]] = {BARE: [], DETECTOR: []}
        for _ in range(options.rounds):
            for receiver, found in runs.items():
                found.append(measure(receiver, publishers, options))
        missed |= not show(publishers, options.rules, runs)
    return int(missed)


def show(publishers: int, rules: int, runs: Mapping[str, Sequence[Run]]) -> bool:
    """Print rates, ratio and stages; whether the target is reached."""
    bare, ours = (statistics.median(run.rate for run in runs[receiver]) for receiver in (BARE, DETECTOR))
    ratios = sorted(mine.rate / other.rate for mine, other in zip(runs[DETECTOR], runs[BARE], strict=True))
    ratio, target = statistics.median(ratios), TARGETS.get(publishers, 0.0)
    print(
        f"{publishers} publisher(s): bare callback {bare / 1e3:.0f} k/s, detector run {ours / 1e3:.0f} k/s, "
        f"ratio {ratio:.2f} (from {ratios[0]:.2f} to {ratios[-1]:.2f}; target {target})"
    )
    least, stages = (a_message(runs[receiver]) for receiver in (BARE, DETECTOR))
    print(f"  ns of CPU a message: bare {sum(least.values()):.0f}, detector {sum(stages.values()):.0f}, which is")
    print("  " + ", ".join(f"{stage} {spent:.0f}" for stage, spent in stages.items()))
    messages = sum(run.count for run in runs[DETECTOR])
    print(
        f"  messages in a burst {messages / sum(run.report['bursts'] for run in runs[DETECTOR]):.1f}, "
        f"longest wait for the buffer {max(run.report['wait'] for run in runs[DETECTOR]):.2f} s, "
        f"ticks a second and rule {statistics.median(run.report['ticks'] for run in runs[DETECTOR]):.1f}, "
        f"evaluations left out of a rule {max(run.report['skipped'] for run in runs[DETECTOR]) / max(rules, 1):.0f}, "
        f"gaps {max(run.report['gaps'] for run in runs[DETECTOR])}, "
        f"events {sum(run.report['events'] for run in runs[DETECTOR])}",
        flush=True,
    )
    return ratio >= target


def a_message(runs: Sequence[Run]) -> dict[str, float]:
    """Nanoseconds of CPU time a message, by stage; without the main threads, which only start and wait."""
    total: Counter[str] = Counter()
    for run in runs:
        total.update(run.report["stages"])
    return {stage: spent / sum(run.count for run in runs) for stage, spent in total.items()}


def measure(receiver: str, publishers: int, options: argparse.Namespace) -> Run:
    """One run."""
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        log_file = Path(folder) / "log"
        process = start_receiver(receiver, endpoint, Path(folder), options.rules, log_file)
        common = ["--endpoint", endpoint, "--seconds", str(options.seconds), "--clients", str(options.clients)]
        senders = [
            subprocess.Popen(
                [*module("intake_rate"), "--role=publisher", *common, "--share", str(index), str(publishers)],
                stdout=subprocess.PIPE,
                text=True,
            )
            for index in range(publishers)
        ]
        outputs = [sender.communicate()[0] for sender in senders]
        if any(sender.returncode for sender in senders):
            process.kill()
            raise SystemExit(f"{receiver}: a publisher failed\n{tail(log_file.read_text())}")
        sent = [json.loads(output) for output in outputs]
        time.sleep(1.0)  # samples that Zenoh accepted from the publishers must reach the receiver
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=120)
        log = log_file.read_text()
    found = [line.removeprefix(MARK) for line in log.splitlines() if line.startswith(MARK)]
    if not found:
        raise SystemExit(f"{receiver}: there is no report in its log\n{tail(log)}")
    report, total = json.loads(found[0]), sum(each["count"] for each in sent)
    if report["count"] != total:
        raise SystemExit(f"{receiver}: of {total} samples {report['count']} arrived: a run without all does not count")
    return Run(total / (report["last"] - min(each["begin"] for each in sent)), total, report)


def tail(log: str) -> str:
    """The end of a log."""
    return "\n".join(log.splitlines()[-20:])


def module(name: str) -> list[str]:
    """The command that runs a module beside this one."""
    return [sys.executable, "-m", f"benchmarks.{name}"]


def start_receiver(receiver: str, endpoint: str, folder: Path, rules: int, log: Path) -> subprocess.Popen[bytes]:
    """Start it with its standard error in the log; it ends with SIGTERM."""
    if receiver == BARE:
        command = [*module("intake_rate"), "--role", BARE, "--endpoint", endpoint]
    else:
        detector, rule_file = speeds.write_documents(folder, rules)
        document = yaml.safe_load(detector.read_text())
        document["spec"]["zenoh"] = {"mode": "peer", "listen": [endpoint], "scouting": False}
        detector.write_text(yaml.safe_dump(document))
        files = ["--detector", str(detector), "--rules", str(rule_file), "--output", str(folder / "out")]
        command = [*module("intake_stages"), "run", *files]
    with log.open("wb") as file:  # an unread pipe would block the detector
        return subprocess.Popen(command, stderr=file)


def settings(**values: object) -> zenoh.Config:
    """A configuration without scouting; double underscores stand for slashes."""
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def count(endpoint: str) -> None:
    """The baseline: a callback that only counts."""
    total = 0

    def receive(_: zenoh.Sample) -> None:
        nonlocal total
        total += 1

    seen, last = 0, 0.0
    with zenoh.open(settings(listen__endpoints=[endpoint])) as session:
        session.declare_subscriber("vehicles/*/speed", receive)
        while signal.sigtimedwait({signal.SIGTERM}, 0.02) is None:
            if total != seen:
                seen, last = total, time.monotonic()
    cpu = time.process_time_ns() - time.thread_time_ns()
    print(MARK + json.dumps({"count": total, "last": last, "stages": {"all": cpu}}), file=sys.stderr)


def publish(endpoint: str, seconds: float, clients: Sequence[int]) -> None:
    """Send the speeds of these clients as fast as the receiver accepts them."""
    config = settings(connect__endpoints=[endpoint], connect__timeout_ms=20_000, listen__endpoints=[])
    turn = 2 * math.pi / PHASES
    payloads = [b'{"speed": %.3f}' % (speeds.MEAN + speeds.SWING * math.sin(turn * phase)) for phase in range(PHASES)]
    with zenoh.open(config) as session:
        publishers = [
            session.declare_publisher(f"vehicles/c{client}/speed", congestion_control=zenoh.CongestionControl.BLOCK)
            for client in clients
        ]
        shifts = [round(client / turn) for client in clients]
        patience = time.monotonic() + PATIENCE
        while not all(publisher.matching_status.matching for publisher in publishers):
            if time.monotonic() > patience:
                raise SystemExit(f"nobody subscribed within {PATIENCE:g} s")
            time.sleep(0.01)
        pairs = [*zip([publisher.put for publisher in publishers], shifts, strict=True)]
        begin = now = time.monotonic()
        sent = 0
        while now - begin < seconds:
            phase = round(speeds.PACE * now / turn)
            for put, shift in pairs:
                put(payloads[(phase + shift) % PHASES])
            sent += len(pairs)
            now = time.monotonic()
        time.sleep(0.5)  # closing the session would drop its queued samples
    print(json.dumps({"count": sent, "begin": begin}))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if BARE in sys.argv:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # before Zenoh's threads start
    sys.exit(main())
