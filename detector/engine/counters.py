"""Counters of every drop, unknown and error, by cause; in replays also the ages of the samples that rules use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from wayside.expressions import Reason

OLD = 3
"""Age limit in usual periods: an older sample shows that its sender fell silent."""

_MANY, _SHARE = 10, 0.1
"""Uses of old samples are reported from this number and this share on: a client that leaves always causes a few."""


class AgedSample(Protocol):
    """A sample of a lane."""

    @property
    def time(self) -> int:
        """Its time, in nanoseconds."""


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


_MAXIMUM_NOTES = 1000

_EARLY = 3600 * 1_000_000_000
"""Nanoseconds: a recording with smaller receive times counts from 0, so a stamp of 0 is a valid time there."""

_MAXIMUM_REASONS = 16
"""Maximum number of distinct reasons per rule: some contain values, which are unbounded."""

OTHERS = "for other reasons"
"""The label under which further reasons are counted."""


@dataclass(slots=True)
class RuleCounters:
    """Counters of the evaluation of one rule."""

    evaluations: int = 0
    skipped: int = 0
    """Evaluations that were due but skipped because the machine was too slow."""
    suppressed: int = 0
    """Episodes suppressed because a client had reached maxEpisodesPerHour."""
    started: int = 0
    ended: int = 0
    unknowns: int = 0
    """Values that were absent when an expression needed them."""
    absences: Counter[str] = field(default_factory=Counter)
    """Number of unknown results by reason; the number of reasons is bounded."""
    errors: int = 0
    """Expressions that failed on values that were present."""
    last_error: str = ""
    misplaced: int = 0
    """Evaluations of a client whose newest sample has no position: absent, not a number, infinite."""
    last_misplaced: str = ""
    ticks: int = 0
    """Number of ticks at which the rule was evaluated, each for all its subjects."""
    last_tick: int = 0
    """The time of the newest of these ticks, in nanoseconds on the engine's time axis."""
    time_ns: int = 0
    """Time spent on its evaluation, by the engine's stopwatch."""

    crowded_pairs: int = 0
    """Pairs within reach that exceeded `maxPairs` and were skipped; counted at each evaluation."""

    unfollowed: int = 0
    """Parameters with `follow` that kept their last value because the new one was unknown or failed; counted at each
    evaluation."""
    last_unfollowed: str = ""
    ages: Ages | None = None
    """The ages of the samples that the rule used; None if not measured."""
    notes: list[str] | None = None
    """If set, collects what expressions missed or failed on; at most a thousand entries."""

    def note(self, reason: Reason, message: str, place: str = "", times: int = 1) -> None:
        """Count an expression's unknown results; `place` names the client and stream in the text of an error."""
        if self.notes is not None and len(self.notes) < _MAXIMUM_NOTES:
            self.notes.append(message)
        if reason is Reason.ERROR:
            self.errors += times
            self.last_error = f"{place}: {message}" if place else message
        else:
            self.unknowns += times
            known = message in self.absences or len(self.absences) < _MAXIMUM_REASONS
            self.absences[message if known else OTHERS] += times

    def timed(self, tick: int, spent: int, ticks: int = 1) -> None:
        """Count an evaluation at a number of ticks up to this one; `tick` and `spent` are nanoseconds."""
        self.ticks += ticks
        self.last_tick = tick
        self.time_ns += spent

    def misplace(self, message: str) -> None:
        """Count a sample without the position of its client."""
        self.misplaced += 1
        self.last_misplaced = message


@dataclass(slots=True)
class Counters:
    """Counters of the engine."""

    samples: Counter[str] = field(default_factory=Counter)
    """Samples taken into the buffer, by stream."""
    undecodable: Counter[str] = field(default_factory=Counter)
    """Payloads that could not be read when a rule or the clock needed them, by stream."""
    last_undecodable: dict[str, str] = field(default_factory=dict)
    unnamed: Counter[str] = field(default_factory=Counter)
    """Samples dropped since neither their key nor their message names a valid client, by stream."""
    last_unnamed: dict[str, str] = field(default_factory=dict)
    """The key and the invalid name of the last sample in `unnamed`, by stream."""
    unstamped: Counter[str] = field(default_factory=Counter)
    """With clock Data, samples without a stamp, by stream: their receive time is used instead."""
    zeros: Counter[str] = field(default_factory=Counter)
    """With clock Data, samples whose stamp is 0, by stream: the sender did not fill in the header."""
    delays: dict[str, int] = field(default_factory=dict)
    """With clock Data, the smallest delay between stamp and receive time, by stream; nanoseconds."""
    crowded: Counter[str] = field(default_factory=Counter)
    """Samples dropped because too many clients were known already, by stream."""
    rules: dict[str, RuleCounters] = field(default_factory=dict)
    watch_ages: bool = False
    """Whether the age of used samples is measured for rules set from now on."""

    def rule(self, name: str) -> RuleCounters:
        """The counters of a rule."""
        if name not in self.rules:
            self.rules[name] = RuleCounters(ages=Ages() if self.watch_ages else None)
        return self.rules[name]

    def stamped(self, stream: str, received: int, stamp: int | None) -> None:
        """Compare a sample's stamp with its receive time; nanoseconds, None: the sample has no stamp."""
        if stamp is None:
            self.unstamped[stream] += 1
            stamp = received
        elif stamp == 0 and received > _EARLY:
            self.zeros[stream] += 1
            return
        delay = received - stamp
        if delay < self.delays.get(stream, delay + 1):
            self.delays[stream] = delay

    def unreadable(self, stream: str, key: str, error: Exception) -> None:
        """Count a payload that could not be read."""
        self.undecodable[stream] += 1
        self.last_undecodable[stream] = f"{key}: {error}"
