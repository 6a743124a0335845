"""Inserting into a buffer costs the same whether it holds 100, 10,000 or 1,000,000 samples.

Rounds over the sizes alternate; the medians are compared with that of the smallest.

    python benchmarks/buffer_insert.py
"""

from __future__ import annotations

import gc
import statistics
import time

from detector.engine.engine import Engine
from detector.engine.samples.sample import Arrival
from wayside.api import Detector

SIZES = (100, 10_000, 1_000_000)
INSERTS = 20_000
ROUNDS = 9
START = 1_767_225_600_000_000_000


class Undecoded:
    """A decoder that is never called, since no rule reads fields."""

    def decode(self, payload: bytes) -> object:
        raise AssertionError(payload)

    def stamp(self, payload: bytes) -> int | None:
        raise AssertionError(payload)


def engine_holding(size: int) -> tuple[Engine, list[Arrival]]:
    """An engine whose buffer contains this number of samples of one client, and the next ones to insert."""
    detector = Detector.model_validate(
        {
            "kind": "Detector",
            "metadata": {"name": "bench"},
            "spec": {
                "streams": [{"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json"}],
                "buffer": {"duration": "100h", "bytes": "100Gi"},
            },
        }
    )
    engine = Engine(
        detector, holder="bench", decoders={"pose": Undecoded()}, read_key=lambda stream, key: ("car", {}), start=START
    )
    # All within one period of the housekeeping, so that only inserts are measured.
    arrivals = [Arrival(START + 1 + i, "pose", "vehicles/car/pose", b"0" * 92) for i in range(size + INSERTS * ROUNDS)]
    engine.advance(arrivals[:size], START)
    return engine, arrivals[size:]


def take_out(engine: Engine, count: int) -> None:
    """Undo the last inserts into the buffer."""
    lane = engine.buffer.lane("car", "pose")
    assert lane is not None
    for _ in range(count):
        lane.samples.pop()


def main() -> None:
    holding = {size: engine_holding(size) for size in SIZES}
    costs: dict[int, list[float]] = {size: [] for size in SIZES}
    gc.collect()
    gc.freeze()
    for round_ in range(ROUNDS):
        for size, (engine, arrivals) in holding.items():
            batch = arrivals[round_ * INSERTS : (round_ + 1) * INSERTS]
            begin = time.perf_counter_ns()
            engine.advance(batch, START)
            costs[size].append((time.perf_counter_ns() - begin) / INSERTS)
            take_out(engine, INSERTS)
    medians = {size: statistics.median(found) for size, found in costs.items()}
    for size, median in medians.items():
        print(f"holding {size:>9,}: {median:6.0f} ns an insert, {median / medians[SIZES[0]]:.2f} of holding {SIZES[0]}")


if __name__ == "__main__":
    main()
