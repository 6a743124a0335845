"""The data quality of a recording, by stream: the number of samples, their clients, regularity, and losses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from detector.engine.counters import Counters
from detector.engine.samples.sample import Arrival
from wayside.api import Detector

Record = TypeVar("Record")


@dataclass(slots=True)
class _Key:
    count: int
    first: int
    last: int
    gap: int = 0
    since: int = 0


@dataclass(frozen=True, slots=True)
class StreamQuality:
    """The quality of one stream."""

    stream: str
    key: str
    """The key pattern."""
    encoding: str
    samples: int
    keys: int
    """Number of keys, mostly one per client."""
    rate: float | None
    """Samples per second of one key, the median over the keys; None if each has fewer than two samples."""
    gap: float | None
    """The longest time between two samples of one key, seconds."""
    gap_key: str | None
    gap_time: int | None
    """The key and the beginning of this gap; nanoseconds since the epoch."""
    unreadable: int
    last_unreadable: str
    unnamed: int


class Arrivals:
    """Counts arrivals while they pass into a replay."""

    def __init__(self) -> None:
        self._keys: dict[tuple[str, str], _Key] = {}

    def watch_batches(self, batches: Iterable[Sequence[Arrival]]) -> Iterator[Sequence[Arrival]]:
        """The same batches, counted."""
        for batch in batches:
            self._count(batch)
            yield batch

    def watch(self, records: Iterable[Record]) -> Iterator[Record]:
        """The same records of an intake file, counted."""
        for record in records:
            if isinstance(record, Arrival):
                self._count((record,))
            yield record

    def _count(self, batch: Iterable[Arrival]) -> None:
        keys = self._keys
        for arrival in batch:
            time = arrival.received
            at = (arrival.stream, arrival.key)
            seen = keys.get(at)
            if seen is None:
                keys[at] = _Key(1, time, time)
                continue
            if time - seen.last > seen.gap:
                seen.gap, seen.since = time - seen.last, seen.last
            seen.last = time
            seen.count += 1

    @property
    def span(self) -> tuple[int, int]:
        """The times of the first and of the last arrival, nanoseconds since the epoch; (0, 0) if there are none."""
        keys = self._keys.values()
        return min((key.first for key in keys), default=0), max((key.last for key in keys), default=0)

    def follow(self, later: Arrivals) -> None:
        """Add the counts of another object that observed the following arrivals."""
        for at, other in later._keys.items():
            seen = self._keys.get(at)
            if seen is None:
                self._keys[at] = other
                continue
            for gap, since in ((other.first - seen.last, seen.last), (other.gap, other.since)):
                if gap > seen.gap:
                    seen.gap, seen.since = gap, since
            seen.last = other.last
            seen.count += other.count

    def by_stream(self, detector: Detector, counters: Counters) -> list[StreamQuality]:
        """The quality of each stream of the Detector, in its order; the counters are the engine's."""
        found = []
        for stream in detector.spec.streams:
            name = stream.name
            keys = {key: seen for (of, key), seen in self._keys.items() if of == name}
            rates = sorted((k.count - 1) * 1e9 / (k.last - k.first) for k in keys.values() if k.last > k.first)
            worst = max(keys, key=lambda key: keys[key].gap, default=None)
            gap = keys[worst] if worst is not None and keys[worst].gap else None
            found.append(
                StreamQuality(
                    stream=name,
                    key=stream.key,
                    encoding=stream.encoding.value,
                    samples=sum(seen.count for seen in keys.values()),
                    keys=len(keys),
                    rate=rates[len(rates) // 2] if rates else None,
                    gap=None if gap is None else gap.gap / 1e9,
                    gap_key=None if gap is None else worst,
                    gap_time=None if gap is None else gap.since,
                    unreadable=counters.undecodable[name],
                    last_unreadable=counters.last_undecodable.get(name, ""),
                    unnamed=counters.unnamed[name],
                )
            )
        return found
