"""How old the samples are that a rule uses, and how often they usually come. Watched in replays alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

OLD = 3
"""Usual periods: a sample that is older shows that its sender fell silent."""

_MANY, _SHARE = 10, 0.1
"""Uses of old samples are reported from this number and share on; a client that leaves always gives a few."""


class AgedSample(Protocol):
    """A sample of a lane."""

    @property
    def time(self) -> int:
        """When it came, in nanoseconds."""


class AgedLane(Protocol):
    """The samples of one client on one stream, in order of time."""

    @property
    def client(self) -> str:
        """Whose they are."""

    @property
    def stream(self) -> str:
        """Which stream they came on."""

    @property
    def latest(self) -> int:
        """The time of the newest, in nanoseconds."""

    @property
    def samples(self) -> Sequence[AgedSample]:
        """Those that are still there."""


@dataclass(slots=True)
class Use:
    """What one rule used of one stream."""

    ages: Counter[int] = field(default_factory=Counter)
    periods: Counter[int] = field(default_factory=Counter)
    newest: dict[str, int] = field(default_factory=dict)
    """By client, the time of the newest sample that was used; nanoseconds."""

    @property
    def period(self) -> int | None:
        """The median time between two samples of a client, in nanoseconds; None where no client sent two."""
        left = self.periods.total() / 2
        for period, count in sorted(self.periods.items()):
            left -= count
            if left <= 0:
                return period
        return None

    @property
    def count(self) -> int:
        """How often a sample was used."""
        return self.ages.total()

    @property
    def old(self) -> int:
        """How often one was that is older than three periods; 0 where that is seldom."""
        period = self.period
        if period is None:
            return 0
        old = sum(count for age, count in self.ages.items() if age > OLD * period)
        return old if old >= _MANY and old >= _SHARE * self.count else 0


class Ages:
    """What a rule used, by stream."""

    def __init__(self) -> None:
        self.uses: dict[str, Use] = {}

    def used(self, lane: AgedLane, now: int) -> None:
        """A value was computed of the lane's newest sample and those before it, at the tick `now` (ns)."""
        use = self.uses.setdefault(lane.stream, Use())
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
