"""What the engine takes live, tick by tick, with fifty rules: CPU time of a tick, and of a sample with onSample.

The workload is that of engine_speed: speeds at 100 Hz, the maximum of the last 1 to 5 s evaluated every 100 ms. Ticks
count once the longest window is full. The baseline decodes the payloads of the same tick and does no more.
Each size is one run: medians and means are over its ticks.

    python -m benchmarks.live_tick [--rules 50] [--clients 1 15 100] [--ticks 100] [--on-sample 15] [--fill 5]
"""

from __future__ import annotations

import argparse
import gc
import statistics
import time
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from benchmarks.workloads import speeds
from benchmarks.workloads.driving import Live, by_tick
from detector.assembly.memory import tune_garbage_collection
from detector.engine.samples.sample import Arrival
from wayside.api import EventRule

HZ = 100


class Message(msgspec.Struct):
    """The struct that the baseline decodes."""

    speed: float


class CpuTimes(NamedTuple):
    """Nanoseconds of CPU time of each tick, and of decoding its payloads; and the samples of all these ticks."""

    engine: list[int]
    decoding: list[int]
    samples: int


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="live_tick", description=__doc__)
    parser.add_argument("--rules", type=int, default=50, help="(%(default)s)")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 15, 100], help="sizes (1 15 100)")
    parser.add_argument("--ticks", type=int, default=100, help="that count, of each size (%(default)s)")
    parser.add_argument("--on-sample", type=int, default=15, help="clients with rules onSample; 0: none (%(default)s)")
    parser.add_argument("--fill", type=float, default=float(speeds.LONGEST), help="s before ticks count (%(default)g)")
    options = parser.parse_args()
    for clients in options.clients:
        rules = speeds.rules(options.rules)
        spent = measure(rules, clients, options.ticks, options.fill)
        median, mean, busy = of_ticks(spent.engine)
        ratio = sum(spent.engine) / sum(spent.decoding)
        print(
            f"{len(rules)} rules, {clients:>3} client(s) at {HZ} Hz: median {median:,.0f} us a tick, "
            f"mean {mean:,.0f} us ({busy:.1%} of a core), {ratio:,.1f} times decoding alone"
        )
    if options.on_sample:
        rules = speeds.rules_on_sample(options.rules)
        spent = measure(rules, options.on_sample, options.ticks, options.fill)
        _, _, busy = of_ticks(spent.engine)
        ratio = sum(spent.engine) / sum(spent.decoding)
        print(
            f"{len(rules)} rules onSample, {options.on_sample} client(s) at {HZ} Hz: "
            f"{sum(spent.engine) / spent.samples / 1e3:,.0f} us a sample ({busy:.1%} of a core), "
            f"{ratio:,.1f} times decoding alone"
        )


def measure(rules: Sequence[EventRule], clients: int, ticks: int, fill: float) -> CpuTimes:
    """Fill the windows, then measure `ticks` ticks; `fill` is seconds."""
    before = round(fill * 1e9 / speeds.TICK)
    arrivals = list(speeds.arrivals(clients, HZ, (before + ticks + 1) * speeds.TICK / 1e9))
    parts = list(by_tick(arrivals, speeds.TICK))[: before + ticks]
    live = Live(speeds.detector(), rules, speeds.START - 1)
    for tick, part in parts[:before]:
        live.advance(part, tick)
    tune_garbage_collection()
    spent = CpuTimes([], [], sum(len(part) for _, part in parts[before:]))
    for tick, part in parts[before:]:
        begin = time.process_time_ns()
        live.advance(part, tick)
        between = time.process_time_ns()
        decode(part)
        spent.decoding.append(time.process_time_ns() - between)
        spent.engine.append(between - begin)
    gc.unfreeze()
    return spent


_decode = msgspec.json.Decoder(Message).decode


def decode(part: Sequence[Arrival]) -> None:
    """The baseline."""
    for each in part:
        _decode(each.payload)


def of_ticks(spent: Sequence[int]) -> tuple[float, float, float]:
    """Median and mean in microseconds, and the share of a core that this is."""
    mean = statistics.fmean(spent)
    return statistics.median(spent) / 1e3, mean / 1e3, mean / speeds.TICK


if __name__ == "__main__":
    main()
