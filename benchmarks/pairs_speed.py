"""CPU time of a tick of a pairs rule with a thousand, ten thousand and a hundred thousand clients, and how it grows.

Clients walk at random in a square in which each has three others within 30 m on average, and send their position once
a second; the rule looks at pairs within 30 m once a second, and an episode lasts from a distance below 10 m to one
above 15 m. Decoding is part of a tick. Sizes are compared with the smallest; a growth of 1 is that of the clients.

    python -m benchmarks.pairs_speed [--clients 1000 10000 100000] [--ticks 5] [--esper]

`--esper` also builds and measures the peer in `benchmarks/peers/esper` with up to 10,000 clients: Esper parses the same
payloads and finds neighbours by its quadtree index. Exits with 1 where it finds another number of events.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.workloads import crowd, esper
from benchmarks.workloads.driving import Live
from benchmarks.workloads.speeds import write_json_lines
from detector.assembly.memory import tune_garbage_collection
from detector.engine.samples.sample import Arrival

PEER_UP_TO = 10_000


class CpuTimes(NamedTuple):
    """Seconds of CPU time of each tick but the first, and of all; the episodes that started and ended in all."""

    ticks: list[float]
    total: float
    starts: int
    ends: int


def main() -> int:
    """Measure and print; 1 means that the peer found other events."""
    parser = argparse.ArgumentParser(prog="pairs_speed", description=__doc__)
    parser.add_argument("--clients", type=int, nargs="+", default=[1000, 10_000, 100_000], help="sizes")
    parser.add_argument("--ticks", type=int, default=5, help="that count, after a first one (%(default)s)")
    parser.add_argument("--esper", action="store_true", help="also measure the peer")
    options = parser.parse_args()
    if options.esper:
        esper.build()
    measure(list(crowd.parts(100, 2)))  # warm up imports and caches
    same = True
    smallest: tuple[int, float] | None = None
    for clients in options.clients:
        parts = list(crowd.parts(clients, options.ticks + 1))
        spent = measure(parts)
        median = statistics.median(spent.ticks)
        smallest = smallest or (clients, median)
        growth = median / smallest[1] / (clients / smallest[0])
        print(
            f"{clients:>7,} clients: median {median * 1e3:,.1f} ms a tick, {median / clients * 1e6:.2f} us a client, "
            f"growth {growth:.2f}; {spent.starts:,} episodes started, {spent.ends:,} ended in {len(parts)} ticks"
        )
        if options.esper and clients <= PEER_UP_TO:
            same &= compare(parts, clients, spent)
    return 0 if same else 1


def measure(parts: Sequence[tuple[int, Sequence[Arrival]]]) -> CpuTimes:
    """Drive the engine tick by tick."""
    live = Live(crowd.detector(), [crowd.rule()], crowd.START)
    tune_garbage_collection()
    ticks: list[float] = []
    events = []
    for tick, part in parts:
        begin = time.process_time()
        events += live.advance(part, tick)
        ticks.append(time.process_time() - begin)
    starts = sum(event.started for event in events)
    return CpuTimes(ticks[1:], sum(ticks), starts, len(events) - starts)


def compare(parts: Sequence[tuple[int, Sequence[Arrival]]], clients: int, spent: CpuTimes) -> bool:
    """Print what the peer takes; whether it finds as many starts and ends as Wayside."""
    arrivals = [each for _, part in parts for each in part]
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "crowd.jsonl"
        write_json_lines(recording, arrivals)
        metres = [crowd.side(clients), crowd.WITHIN, crowd.BELOW, crowd.ABOVE]
        found = esper.run(["pairs", str(recording), *map(str, metres)], samples=len(arrivals), rounds=3)
    equal = (found.starts, found.ends) == (spent.starts, spent.ends)
    counts = "the same events" if equal else f"OTHER EVENTS: {found.starts:,} started, {found.ends:,} ended"
    print(
        f"        Esper: median {found.tick * 1e3:,.1f} ms a tick by CPU time of its thread "
        f"({found.jvm:.1f} times that for the JVM), {counts}; "
        f"Wayside takes {statistics.median(spent.ticks) / found.tick:.2f} times as long, "
        f"{spent.total / found.thread:.2f} times over all ticks with the first, when all clients are new to Wayside"
    )
    return equal


if __name__ == "__main__":
    sys.exit(main())
