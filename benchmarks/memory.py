"""How many bytes a buffered sample costs beside its payload, with one rule that reads a field of each.

An engine takes in small samples of many clients that it keeps all. Measured is the growth of the process's resident
memory for each sample, minus the payload and 8 bytes for the field that the rule reads. The rest is compared with the
bound.

    python -m benchmarks.memory [--clients 100] [--samples 1000000] [--bound 200]

Exits with 1 where the bound is missed.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import itertools
import os
import sys
from pathlib import Path

from benchmarks.workloads import speeds
from benchmarks.workloads.driving import Live, by_tick
from wayside.api import EventRule

HZ = 100
FIELD = 8
"""Bytes: the number that the rule reads."""

WARM = 0.1
"""The share of samples that comes first and does not count: one-time allocations happen there."""


def main() -> int:
    """Measure and print; 1 means that the bound is missed."""
    parser = argparse.ArgumentParser(prog="memory", description=__doc__)
    parser.add_argument("--clients", type=int, default=100, help="(%(default)s)")
    parser.add_argument("--samples", type=int, default=1_000_000, help="(%(default)s)")
    parser.add_argument("--bound", type=float, default=200.0, help="bytes a sample (%(default)g)")
    options = parser.parse_args()
    seconds = options.samples / HZ / options.clients
    keep = f"{int(seconds) + 60}s"
    document = speeds.rule_document(speeds.limits(1)[0], {"every": "1s"})
    live = Live(speeds.detector(keep), [EventRule.model_validate(document)], speeds.START - 1)
    parts = by_tick(speeds.arrivals(options.clients, HZ, seconds), speeds.TICK)
    warm = round(seconds * 1e9 / speeds.TICK * WARM)
    for tick, part in itertools.islice(parts, warm):
        live.advance(part, tick)
    before = resident()
    samples = payload = 0
    for tick, part in parts:
        live.advance(part, tick)
        samples += len(part)
        payload += sum(len(each.payload) for each in part)
    grown = resident() - before
    each, bytes_ = grown / samples, payload / samples
    beside = each - bytes_ - FIELD
    print(
        f"{options.clients} clients, {samples:,} samples: resident memory grew by {each:.0f} bytes a sample; "
        f"without {bytes_:.0f} of payload and {FIELD} for the field {beside:.0f}, "
        f"{beside / options.bound:.2f} of the bound of {options.bound:g}"
    )
    return 0 if beside <= options.bound else 1


def resident() -> int:
    """Bytes of memory of this process, without what it has freed."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE")


if __name__ == "__main__":
    sys.exit(main())
