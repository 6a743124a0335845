"""How many samples a second the engine evaluates, with one rule and with fifty, beside decoding the payloads alone.

Clients send their speed at a fixed rate; the rules are of the form "the maximum of the last 1 s (to 5 s) is above a
limit, until it is below another", evaluated every 100 ms. Measured is the CPU time from payloads in memory to events,
as `detector replay` makes them, without the time to compile the rules. The baseline, in the same rounds, decodes each
payload into a struct and does no more.

    python -m benchmarks.engine_speed [--clients 100] [--hz 100] [--seconds 10] [--repeat 3] [--rules 1 50]
                                      [--file] [--mcap] [--esper]

`--file` also measures `detector replay` as a process, from a file of JSON lines to events.jsonl, its start included.
`--mcap` measures it without imports, from an MCAP file of poses, beside the library mcap that only reads the file.
`--esper` also builds and measures the peer in `benchmarks/peers/esper`: Esper parses the same payloads and evaluates
the same rules on one thread, with a window for each rule (plain, of up to five rules), with one for each length
(tuned), and over maxima of 100 ms (panes). Wayside makes events with ids, times and values; the peer only counts starts
and ends.
Exits with 1 where the peer finds another number of events.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import io
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
from mcap.reader import SeekingReader

from benchmarks.workloads import esper, speeds
from benchmarks.workloads.driving import replayed
from detector.assembly.memory import tune_garbage_collection
from detector.commands.replay import replay_files
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from wayside.api import EventRule

TARGET = 500_000
"""Samples a second of a whole replay with fifty rules."""

PLAIN_UP_TO = 5
"""Rules: a separate window for each of fifty would measure the EPL, not Esper."""


class Message(msgspec.Struct):
    """The struct that the baseline decodes."""

    speed: float


def main() -> int:
    """Measure and print; 1 means that the peer found other events."""
    parser = argparse.ArgumentParser(prog="engine_speed", description=__doc__)
    parser.add_argument("--clients", type=int, default=100, help="(%(default)s)")
    parser.add_argument("--hz", type=int, default=100, help="samples a second of each client (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of data (%(default)g)")
    parser.add_argument("--repeat", type=int, default=3, help="rounds (%(default)s)")
    parser.add_argument("--rules", type=int, nargs="+", default=[1, 50], help="numbers of rules (1 50)")
    parser.add_argument("--file", action="store_true", help="also measure detector replay as a process")
    parser.add_argument("--mcap", action="store_true", help="also measure it from an MCAP file")
    parser.add_argument("--esper", action="store_true", help="also measure the peer")
    options = parser.parse_args()
    arrivals = list(speeds.arrivals(options.clients, options.hz, options.seconds))
    print(
        f"{options.clients} client(s) at {options.hz} Hz for {options.seconds:g} s: {len(arrivals):,} samples; "
        f"medians of {options.repeat}, CPU time"
    )
    if options.esper:
        esper.build()
    tune_garbage_collection()
    same = True
    with tempfile.TemporaryDirectory() as folder:
        recording, mcap = Path(folder) / "recording.jsonl", Path(folder) / "recording.mcap"
        speeds.write_json_lines(recording, arrivals)
        if options.mcap:
            speeds.write_mcap(mcap, arrivals)
        for count in options.rules:
            seconds, events = measure(arrivals, speeds.rules(count), options.repeat)
            if options.file:
                measure_replay(recording, count, len(arrivals), options.repeat)
            if options.mcap:
                measure_mcap(mcap, count, len(arrivals), options.repeat)
            if options.esper:
                same &= compare(recording, count, seconds, events, len(arrivals), options.repeat)
    return 0 if same else 1


def measure(arrivals: Sequence[Arrival], rules: Sequence[EventRule], rounds: int) -> tuple[float, list[Event]]:
    """The median CPU time of a replay in seconds, without its set-up; and its events."""
    decode = msgspec.json.Decoder(Message).decode
    replayed(arrivals[:1], speeds.detector(), rules)  # warm up imports and caches
    spent: list[float] = []
    setups: list[float] = []
    baseline: list[float] = []
    events: list[Event] = []
    for _ in range(rounds):
        detector = speeds.detector()
        gc.collect()
        times = [time.process_time()]
        replayed((), detector, rules)
        times.append(time.process_time())
        events = replayed(arrivals, detector, rules)
        times.append(time.process_time())
        for each in arrivals:
            decode(each.payload)
        times.append(time.process_time())
        setup, whole, decoding = (end - begin for begin, end in itertools.pairwise(times))
        spent.append(whole - setup)
        setups.append(setup)
        baseline.append(decoding)
    engine, setup, decoding = (statistics.median(each) for each in (spent, setups, baseline))
    started = sum(event.started for event in events)
    print(
        f"{len(rules):>3} rule(s): engine {rate(len(arrivals), engine)}, {engine / decoding:.1f} times decoding alone "
        f"({rate(len(arrivals), decoding)}); {started:,} episodes started, {len(events) - started:,} ended; "
        f"set-up {setup * 1e3:.0f} ms more"
    )
    return engine, events


def measure_replay(recording: Path, count: int, samples: int, rounds: int) -> None:
    """Print what `detector replay` takes from its start to its end."""
    detector, rules = speeds.write_documents(recording.parent, count)
    program = str(Path(sys.executable).with_name("detector"))
    command = [program, "replay", str(recording), "--output", str(recording.parent / "out")]
    found = [
        process_time([*command, "--detector", str(detector), "--rules", str(rules)], recording.parent / "log")
        for _ in range(rounds)
    ]
    taken = statistics.median(found)
    print(f"           detector replay, JSON lines to events.jsonl: {taken:.2f} s, {rate(samples, taken)}")


def measure_mcap(recording: Path, count: int, samples: int, rounds: int) -> None:
    """Print what a replay of an MCAP file takes beside only reading it, in rounds that alternate."""
    detector, rules = speeds.write_documents(recording.parent, count, poses=True)
    output = recording.parent / "out"

    def replay() -> None:
        with contextlib.redirect_stderr(io.StringIO()):
            replay_files([recording], output, detector, [rules], as_one=False)

    def read() -> None:
        with recording.open("rb") as file:
            deque(SeekingReader(file).iter_messages(), maxlen=0)

    spent: dict[Callable[[], None], list[float]] = {replay: [], read: []}
    for _ in range(rounds):
        for work, times in spent.items():
            times.append(apart(work))
    whole, reading = (statistics.median(times) for times in spent.values())
    print(
        f"           whole replay, MCAP to events.jsonl: {rate(samples, whole)} (target {TARGET / 1e3:,.0f} k/s), "
        f"{reading / whole:.2f} times as fast as the library mcap only reads ({rate(samples, reading)})"
    )


def apart(work: Callable[[], None]) -> float:
    """The CPU time of work in a process that has imported everything, but has not compiled or decoded before."""
    gc.collect()
    child = os.fork()
    if not child:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    _, status, used = os.wait4(child, 0)
    if status:
        raise RuntimeError("a measured process failed")
    return used.ru_utime + used.ru_stime


def process_time(command: Sequence[str], log: Path) -> float:
    """The CPU time of a command, in seconds. Raises RuntimeError where it fails."""
    with log.open("w") as stderr:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{command} ended with {process.returncode}:\n{log.read_text()[-2000:]}")
    return used.ru_utime + used.ru_stime


def compare(recording: Path, count: int, seconds: float, events: Sequence[Event], samples: int, rounds: int) -> bool:
    """Print what the peer takes; whether it finds as many starts and ends as Wayside."""
    rules = recording.with_name("rules.csv")
    speeds.write_limits(rules, count)
    starts = sum(event.started for event in events)
    same = True
    for variant in ("plain", "tuned", "panes"):
        if variant == "plain" and count > PLAIN_UP_TO:
            continue
        mode = ["windows", variant, str(recording), str(rules)]
        found = esper.run(mode, samples=samples, rounds=max(rounds, 3))
        equal = (found.starts, found.ends) == (starts, len(events) - starts)
        same &= equal
        counts = "the same events" if equal else f"OTHER EVENTS: {found.starts:,} started, {found.ends:,} ended"
        print(
            f"           Esper, {variant}: {rate(found.samples, found.thread)} by CPU time of its thread "
            f"({found.jvm:.1f} times that for the JVM), {counts}; "
            f"Wayside takes {seconds / found.thread:.2f} times as long"
        )
    return same


def rate(samples: int, seconds: float) -> str:
    """Samples a second."""
    return f"{samples / seconds / 1e3:,.1f} k samples/s"


if __name__ == "__main__":
    sys.exit(main())
