"""What there is to look at: all samples that ever came, and who is known."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

SECOND = 10**9


@dataclass(frozen=True)
class Sample:
    """One message. `number` is the order of arrival."""

    time: int
    number: int
    client: str
    stream: str
    message: Any
    payload: bytes
    received: int


@dataclass
class Known:
    """A client that is there."""

    since: int
    last: int


@dataclass
class World:
    """All that came until now; times are nanoseconds."""

    timeout: int
    durations: dict[str, int]
    """How long each stream is kept."""
    stale_after: dict[str, int | None]
    samples: list[Sample] = field(default_factory=list)
    known: dict[str, Known] = field(default_factory=dict)
    floor: int | None = None
    """Windows reach back to the last gap at most."""

    def take(self, sample: Sample) -> None:
        """A sample arrives."""
        self.samples.append(sample)
        known = self.known.setdefault(sample.client, Known(sample.time, sample.time))
        known.last = max(known.last, sample.time)

    def gap(self, time: int) -> None:
        """Nobody could be heard up to here."""
        self.floor = time
        for known in self.known.values():
            known.last = time

    def lose(self, now: int) -> set[str]:
        """Who has been silent for too long."""
        lost = {name for name, known in self.known.items() if now - known.last > self.timeout}
        for name in lost:
            del self.known[name]
        return lost

    def of(self, client: str, stream: str, now: int) -> list[Sample]:
        """All samples of a client on a stream, in order."""
        mine = [each for each in self.samples if (each.client, each.stream) == (client, stream) and each.time <= now]
        return sorted(mine, key=lambda each: (each.time, each.number))

    def kept(self, client: str, stream: str, now: int) -> list[Sample]:
        """Those that the buffer still has: of the last seconds, and the newest in any case."""
        mine = self.of(client, stream, now)
        return [each for each in mine if each.time > now - self.durations[stream]] or mine[-1:]

    def fresh(self, client: str, stream: str, now: int) -> bool:
        """Whether the stream is not stale."""
        mine, limit = self.of(client, stream, now), self.stale_after[stream]
        return bool(mine) and (limit is None or now - mine[-1].time <= limit)
