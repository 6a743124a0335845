"""The input of the reference engine: all samples received so far, and the known clients."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

SECOND = 10**9

OVERHEAD = 160
"""The size of a sample beyond its payload, in bytes."""


@dataclass(frozen=True)
class Sample:
    """One message; None if it cannot be decoded. `number` is the order of arrival."""

    time: int
    number: float
    client: str
    stream: str
    message: Any
    payload: bytes
    received: int
    item: Any = None
    """The client's item in the message's list, if the stream has items."""
    before: Any = None
    """The client's previous message, unless it was stale by then."""
    share: int | None = None
    """The number of payload bytes attributed to it; None: all."""


def listed(message: Any) -> dict[str, Any]:
    """The items of a message by client name; the first one if several have the same name."""
    items = message.get("list") if isinstance(message, dict) else None
    found: dict[str, Any] = {}
    for item in items if isinstance(items, list) else []:
        name = item.get("id") if isinstance(item, dict) else None
        if isinstance(name, str) and name:
            found.setdefault(name, item)
    return found


@dataclass
class KnownClient:
    """A known client."""

    since: int
    last: int
    items: bool
    """Whether it is known only as an item of lists."""


@dataclass
class Received:
    """All samples received so far; times are nanoseconds."""

    timeout: int
    durations: dict[str, int]
    """The buffer duration of each stream."""
    stale_after: dict[str, int | None]
    counts: dict[str, int] = field(default_factory=dict)
    """The maximum number of samples per client, for some streams."""
    sizes: dict[str, int] = field(default_factory=dict)
    """The maximum number of bytes per client, for some streams."""
    size: int | None = None
    """The maximum number of bytes in total."""
    samples: list[Sample] = field(default_factory=list)
    known: dict[str, KnownClient] = field(default_factory=dict)
    floor: int | None = None
    """Windows start after the last gap."""
    gone: dict[float, int] = field(default_factory=dict)
    """The samples that left the buffer, by number, and when they left."""
    items: frozenset[str] = frozenset()
    """The streams with items."""

    def take(self, sample: Sample) -> None:
        """A sample arrives."""
        of_items = sample.stream in self.items
        earlier = [each for each in self._held(sample.client, sample.stream) if each.time <= sample.time]
        limit = self.stale_after[sample.stream]
        if earlier and (limit is None or sample.time - earlier[-1].time <= limit):
            sample = replace(sample, before=earlier[-1].item if of_items else earlier[-1].message)
        self.samples.append(sample)
        known = self.known.setdefault(sample.client, KnownClient(sample.time, sample.time, of_items))
        known.last = max(known.last, sample.time)
        known.items = known.items and of_items
        held = self._held(sample.client, sample.stream)
        while len(held) > self.counts.get(sample.stream, len(held)):
            self.gone[held.pop(0).number] = sample.time
        while len(held) > 1 and _size(held) > self.sizes.get(sample.stream, _size(held)):
            self.gone[held.pop(0).number] = sample.time
        everything = [each for each in self.samples if each.number not in self.gone]
        if self.size is not None and _size(everything) > self.size:
            everything.sort(key=lambda each: (each.time, each.client, each.stream, each.number))
            while _size(everything) > self.size - self.size // 64:
                self.gone[everything.pop(0).number] = sample.time

    def sweep(self, now: int) -> None:
        """A whole second: what is older than its duration leaves the buffer, but for the newest."""
        for client, stream in {(each.client, each.stream) for each in self.samples}:
            for each in self._held(client, stream)[:-1]:
                if each.time <= now - self.durations[stream]:
                    self.gone[each.number] = now

    def _held(self, client: str, stream: str, then: int | None = None) -> list[Sample]:
        """The buffered samples of a client's stream, in order; `then`: those at that time."""
        mine = [each for each in self.samples if (each.client, each.stream) == (client, stream)]
        return sorted(
            (each for each in mine if each.number not in self.gone or self.gone[each.number] > (then or math.inf)),
            key=lambda each: (each.time, each.number),
        )

    def gap(self, time: int) -> None:
        """A gap up to here: ranges do not reach back before it, and no client counts as silent before it."""
        self.floor = time
        for known in self.known.values():
            known.last = time

    def lose(self, now: int) -> set[str]:
        """Remove and return the clients that were silent for too long."""
        stale = [limit for limit in (self.stale_after[stream] for stream in self.items) if limit is not None]
        patience = min([*stale, self.timeout])
        lost = {
            name for name, known in self.known.items() if now - known.last > (patience if known.items else self.timeout)
        }
        for name in lost:
            del self.known[name]
        # An item that comes under the name of a lost client is another object.
        self.samples = [each for each in self.samples if each.client not in lost or each.stream not in self.items]
        return lost

    def of(self, client: str, stream: str, now: int) -> list[Sample]:
        """All samples of a client on a stream, in order."""
        mine = [each for each in self.samples if (each.client, each.stream) == (client, stream) and each.time <= now]
        return sorted(mine, key=lambda each: (each.time, each.number))

    def kept(self, client: str, stream: str, now: int) -> list[Sample]:
        """The visible samples: those of the last seconds, and always the newest."""
        mine = [each for each in self._held(client, stream, now) if each.time <= now]
        return [each for each in mine if each.time > now - self.durations[stream]] or mine[-1:]

    def fresh(self, client: str, stream: str, now: int) -> bool:
        """Whether the stream is not stale."""
        mine, limit = self.of(client, stream, now), self.stale_after[stream]
        return bool(mine) and (limit is None or now - mine[-1].time <= limit)


def _size(samples: list[Sample]) -> int:
    return sum((len(each.payload) if each.share is None else each.share) + OVERHEAD for each in samples)
