"""How much the buffer holds, stream by stream."""

from __future__ import annotations

from dataclasses import dataclass

from detector.engine.buffering.buffer import Buffer


@dataclass(slots=True)
class Usage:
    """What the buffer holds of one stream, over all clients."""

    clients: int = 0
    samples: int = 0
    bytes: int = 0
    """Payloads, and SAMPLE_OVERHEAD for each sample."""
    evicted: int = 0
    """Samples of the clients that are there that a cap pushed out before their time."""


def buffer_usage(buffer: Buffer) -> dict[str, Usage]:
    """By stream; the bytes sum up to those of the buffer. To be called by the thread that drives the engine."""
    usage: dict[str, Usage] = {}
    for lane in buffer:
        of_stream = usage.setdefault(lane.stream, Usage())
        of_stream.clients += 1
        of_stream.samples += len(lane.samples)
        of_stream.bytes += lane.bytes
        of_stream.evicted += lane.evicted
    return usage
