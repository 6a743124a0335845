"""`detector` with clocks around the stages of its intake, for the benchmark intake_rate.

Takes the arguments of the program. Every clock is around a batch. When the detector ends, what they measured goes to
standard error as one line of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from benchmarks.intake_rate import MARK
from detector.commands import cli
from detector.engine.buffering.ingest import Ingest
from detector.engine.engine import Engine
from detector.engine.evaluation.blocks import Blocks
from detector.engine.evaluation.inputs import RuleInputs
from detector.engine.samples.intake import Intake
from detector.engine.samples.sample import Arrival
from detector.findings.losses import Losses
from detector.streams.stream_input import StreamInput

spent: Counter[str] = Counter()
"""By stage, CPU time in nanoseconds."""

threads: dict[str, int] = {}
"""By kind of thread, its CPU time so far in nanoseconds."""

seen: Counter[str] = Counter()


def clocked(stage: str, thread: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, whose CPU time counts for the stage."""
    clock = time.thread_time_ns

    def measured(*args: Any, **kwargs: Any) -> Any:
        begin = clock()
        try:
            return function(*args, **kwargs)
        finally:
            threads[thread] = end = clock()
            spent[stage] += end - begin

    return measured


def clock_all() -> None:
    """Put clocks around all stages."""
    putter, insert, run = Intake.putter, Ingest.insert, Blocks.run
    last = wait = 0.0

    def clocked_putter(intake: Intake, stream: str) -> Callable[..., None]:
        return clocked("queue", "stream", putter(intake, stream))

    def clocked_insert(ingest: Ingest, arrivals: Sequence[Arrival], times: Sequence[int] | None, size: int) -> None:
        nonlocal last, wait
        insert(ingest, arrivals, times, size)
        last, wait = time.monotonic(), max(wait, (time.time_ns() - arrivals[0].received) / 1e9)

    def clocked_run(blocks: Blocks, *args: Any) -> Any:
        happened = run(blocks, *args)
        seen["events"] += len(happened)
        return happened

    bursts = StreamInput.bursts

    def clocked_bursts(stream_input: StreamInput) -> Iterator[Any]:
        take = clocked("receive", "stream", bursts(stream_input).__next__)
        while True:
            seen["bursts"] += 1
            yield take()

    report = Losses.sum_up

    def sum_up(losses: Losses) -> None:
        report(losses)
        counters = losses._engine.counters
        rules = counters.rules.values()
        print(
            MARK
            + json.dumps(
                {
                    "count": sum(counters.samples.values()),
                    "last": last,
                    "wait": wait,
                    "stages": stages(),
                    "bursts": seen["bursts"],
                    "events": seen["events"],
                    "ticks": min((rule.ticks for rule in rules), default=0) / (time.monotonic() - began),
                    "gaps": seen["gaps"],
                    "skipped": sum(rule.skipped for rule in rules),
                }
            ),
            file=sys.stderr,
        )

    def clocked_gap(engine: Engine, until: int) -> Any:
        seen["gaps"] += 1
        return gap(engine, until)

    gap, began = Engine.gap, time.monotonic()
    Engine.gap = clocked_gap  # type: ignore[method-assign]
    Intake.putter = clocked_putter  # type: ignore[method-assign]
    Intake.drain = clocked("drain", "evaluator", Intake.drain)  # type: ignore[method-assign]
    Ingest.insert = clocked("insert", "evaluator", clocked_insert)  # type: ignore[method-assign]
    RuleInputs.update_tables = clocked("tables", "evaluator", RuleInputs.update_tables)  # type: ignore[method-assign]
    Blocks.run = clocked("evaluation", "evaluator", clocked_run)  # type: ignore[method-assign]
    Engine.advance = clocked("advance", "evaluator", Engine.advance)  # type: ignore[method-assign]
    StreamInput.bursts = clocked_bursts  # type: ignore[method-assign]
    Losses.sum_up = sum_up  # type: ignore[method-assign]


def stages() -> dict[str, int]:
    """CPU time by stage in nanoseconds; together, that of all threads but the main one, which calls this."""
    stream, evaluator = threads.get("stream", 0), threads.get("evaluator", 0)
    inside = spent["insert"] + spent["tables"] + spent["evaluation"]
    return {
        "receive": spent["receive"],
        "extract": stream - spent["receive"] - spent["queue"],
        "queue": spent["queue"],
        "drain": spent["drain"],
        "insert": spent["insert"],
        "tables": spent["tables"],
        "evaluation": spent["evaluation"],
        "rest of the engine": spent["advance"] - inside,
        "rest of its thread": evaluator - spent["advance"] - spent["drain"],
        "other threads": time.process_time_ns() - time.thread_time_ns() - stream - evaluator,
    }


if __name__ == "__main__":
    clock_all()
    cli.app()
