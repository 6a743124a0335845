"""The age of the samples that a rule uses, and the usual period between samples. Measured in replays only."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

OLD = 3
"""In usual periods: an older sample shows that its sender fell silent."""

_MANY, _SHARE = 10, 0.1
"""Uses of old samples are reported from this number and this share on: a client that leaves always causes a few."""


class AgedSample(Protocol):
    """A sample of a lane."""

    @property
    def time(self) -> int:
        """When it came, in nanoseconds."""


class AgedLane(Protocol):
    """The samples of one client on one stream, in time order."""

    @property
    def client(self) -> str:
        """The client that sent them."""

    @property
    def stream(self) -> str:
        """The stream that they belong to."""

    @property
    def latest(self) -> int:
        """The time of the newest sample, in nanoseconds."""

    @property
    def samples(self) -> Sequence[AgedSample]:
        """The samples that are still in the buffer."""


@dataclass(slots=True)
class StreamUse:
    """The samples of one stream that one rule used."""

    ages: Counter[int] = field(default_factory=Counter)
    periods: Counter[int] = field(default_factory=Counter)
    newest: dict[str, int] = field(default_factory=dict)
    """Per client, the time of the newest sample that was used; nanoseconds."""

    @property
    def period(self) -> int | None:
        """The median time between two samples of a client, in nanoseconds; None if no client sent two."""
        left = self.periods.total() / 2
        for period, count in sorted(self.periods.items()):
            left -= count
            if left <= 0:
                return period
        return None

    @property
    def count(self) -> int:
        """Number of uses of samples."""
        return self.ages.total()

    @property
    def old(self) -> int:
        """Number of uses of samples older than three periods; 0 if these are rare."""
        period = self.period
        if period is None:
            return 0
        old = sum(count for age, count in self.ages.items() if age > OLD * period)
        return old if old >= _MANY and old >= _SHARE * self.count else 0


class Ages:
    """The samples that a rule used, by stream."""

    def __init__(self) -> None:
        self.uses: dict[str, StreamUse] = {}

    def used(self, lane: AgedLane, now: int) -> None:
        """Note that a value was computed from the lane's newest sample and earlier ones, at the tick `now` (ns)."""
        use = self.uses.setdefault(lane.stream, StreamUse())
        use.ages[_rounded(now - lane.latest)] += 1
        before = use.newest.get(lane.client)
        if before != lane.latest:
            use.newest[lane.client] = lane.latest
            if len(lane.samples) > 1:
                before = lane.samples[-2].time
            if before is not None and lane.latest > before:
                use.periods[_rounded(lane.latest - before)] += 1


def _rounded(nanoseconds: int) -> int:
    """Rounded to three digits: precise enough for typical ages, and few distinct values."""
    return round(nanoseconds, 3 - len(str(nanoseconds)))
