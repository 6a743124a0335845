"""What enters the engine: samples, and how their payloads are read."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

SAMPLE_OVERHEAD = 160
"""What a sample costs in memory beside its payload, in bytes: its tuple, its numbers and its place in a queue."""


class Arrival(NamedTuple):
    """One message as the intake queued it, before the engine has looked at it."""

    received: int
    """When the intake took it, in nanoseconds since the epoch; strictly increasing within a detector."""
    stream: str
    """The Detector's stream that it came in on."""
    key: str
    """The full Zenoh key (or topic without its leading slash)."""
    payload: bytes
    """The message as it came, undecoded."""


class Sample(NamedTuple):
    """One message in the buffer."""

    time: int
    """Its place on the engine's time axis, in nanoseconds: the receive time, or with clock Data the stamp."""
    number: int
    """The order of arrival; tells apart samples of the same time."""
    payload: bytes
    """The message as it came, undecoded."""
    received: int
    """When the intake took it, in nanoseconds since the epoch."""
    key: str
    """The full key it came on."""


class DecodeError(ValueError):
    """A payload that its codec cannot read; the text says what is wrong with it."""


class Decoder(Protocol):
    """Reads the payloads of one stream. Stateless; raises nothing but `DecodeError`."""

    def decode(self, payload: bytes) -> Any:
        """The message as plain maps, lists, strings, booleans, None, bytes and floats (integers as doubles).

        Integers beyond 2^53 stay integers. NaN and infinities pass. Arrays are lists.
        """

    def stamp(self, payload: bytes) -> int | None:
        """The sender's time in nanoseconds since the epoch, or None where the message carries none."""
