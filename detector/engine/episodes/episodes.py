"""When an episode starts and ends, for one subject of one rule: a small state machine over Kleene's logic.

    resting ──cooldown over──▶ idle ──condition holds──▶ pending ──for as long as `for`──▶ open ──end──▶ resting

Nothing starts or ends while the condition is unknown. An unknown that lasts longer than `for` resets the onset, and one
that lasts as long as `unknownTimeout` ends an open episode.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from wayside.expressions import UNKNOWN, Unknown

Truth = bool | Unknown


class EndReason(StrEnum):
    """Why an episode ended."""

    UNTIL = "Until"
    OUT_OF_SCOPE = "OutOfScope"
    UNKNOWN = "Unknown"
    CLIENT_LOST = "ClientLost"
    RULE_CHANGED = "RuleChanged"


@dataclass(frozen=True, slots=True)
class Timing:
    """The rule's times, in nanoseconds."""

    hold: int
    """`for`: how long the condition must hold before an episode starts."""
    cooldown: int
    unknown_timeout: int


@dataclass(frozen=True, slots=True)
class Observation:
    """The verdicts of the rule on the subject at one tick."""

    in_scope: Truth
    near: Truth
    """Whether an episode may start at all (a pair within reach)."""
    when: Truth
    until: Truth

    @property
    def code(self) -> int:
        """The observation in one byte."""
        may = both(both(self.in_scope, self.near), both(self.when, negation(self.until)))
        start = TRUE if may is True else FALSE if may is False else UNSURE
        if self.in_scope is False:
            return start | OUTSIDE
        return start | (UNTIL if self.until is True else UNTIL_UNSURE if self.until is UNKNOWN else 0)


class Started(NamedTuple):
    """An episode started; the condition has held since `onset`."""

    onset: int


class Ended(NamedTuple):
    """The open episode ended."""

    reason: EndReason


_UNTIL, _OUT_OF_SCOPE, _UNKNOWN = map(Ended, (EndReason.UNTIL, EndReason.OUT_OF_SCOPE, EndReason.UNKNOWN))

FALSE, UNSURE, TRUE = 0, 1, 2
"""Whether an episode may start: the lower two bits of an observation that is one byte."""
UNTIL_UNSURE, UNTIL, OUTSIDE = 4, 8, 12
"""The condition that may end an episode: the next two bits. 0: none."""
UNSEEN = 255
"""Stands in for an observation before the first one, so any observation is a change."""

NO_WAKE = 2**63 - 1
"""Stands in for a time to wake: nothing happens before the observation changes. Nanoseconds, later than all times."""


Ran = tuple[int, Started | Ended | None, int | None]
"""The result of consecutive ticks with the same observation of a subject: the tick at which something happened, or
after the last one; what happened; and when something will happen although nothing changes, in nanoseconds."""


@dataclass(slots=True)
class SubjectState:
    """The state of a subject. Times are nanoseconds."""

    is_open: bool = False
    onset: int | None = None
    unknown_since: int | None = None
    rests_until: int = 0

    def idle_at(self, now: int) -> bool:
        """Whether the state equals a new one."""
        return not self.is_open and self.onset is None and self.rests_until <= now

    def wake(self, now: int, timing: Timing) -> int | None:
        """The next time, after `now`, at which a timer expires, so that something may happen without a sample;
        nanoseconds."""
        times = []
        if self.is_open:
            if self.unknown_since is None:
                return None
            times.append(self.unknown_since + timing.unknown_timeout)
        elif self.onset is not None:
            times.append(self.onset + timing.hold)
            if self.unknown_since is not None:
                times.append(self.unknown_since + timing.hold + 1)
        else:
            times.append(self.rests_until)
        return min((time for time in times if time > now), default=None)

    def gap(self) -> None:
        """Time jumped without ticks: discard a pending episode, keep an open one."""
        self.onset = None
        self.unknown_since = None

    def end(self, now: int, timing: Timing) -> None:
        """Close the episode; the cooldown begins."""
        self.is_open = False
        self.onset = None
        self.unknown_since = None
        self.rests_until = now + timing.cooldown

    def run(self, ticks: Sequence[int], first: int, last: int, timing: Timing, code: int) -> Ran:
        """The same as calling `step` at each of ticks[first:last] with the same observation, up to the first change.

        Nothing more happens at the later ticks.
        """
        start, stop = code & 3, code & 12
        if self.is_open:
            return self._open_run(ticks, first, last, timing, stop)
        if start == FALSE:
            self.onset = self.unknown_since = None
            return last, None, None
        if start == UNSURE:
            if self.onset is None:
                return last, None, None
            if self.unknown_since is None:
                self.unknown_since = ticks[first]
            due = self.unknown_since + timing.hold + 1
            if ticks[last - 1] < due:
                return last, None, due
            self.onset = self.unknown_since = None
            return last, None, None
        self.unknown_since = None
        if self.onset is None:
            first = bisect_left(ticks, self.rests_until, first, last)
            if first == last:
                return last, None, self.rests_until
            self.onset = ticks[first]
        at = bisect_left(ticks, self.onset + timing.hold, first, last)
        if at == last:
            return last, None, self.onset + timing.hold
        onset, self.onset = self.onset, None
        self.is_open = True
        return at, Started(onset), None

    def _open_run(self, ticks: Sequence[int], first: int, last: int, timing: Timing, stop: int) -> Ran:
        if stop == 0:
            self.unknown_since = None
            return last, None, None
        at, ended = first, _OUT_OF_SCOPE if stop == OUTSIDE else _UNTIL
        if stop == UNTIL_UNSURE:
            if self.unknown_since is None:
                self.unknown_since = ticks[first]
            due = self.unknown_since + timing.unknown_timeout
            at, ended = bisect_left(ticks, due, first, last), _UNKNOWN
            if at == last:
                return last, None, due
        self.end(ticks[at], timing)
        return at, ended, None

    def step(self, now: int, timing: Timing, seen: Observation) -> Started | Ended | None:
        """Advance to the tick `now`; returns what happened."""
        return self.run((now,), 0, 1, timing, seen.code)[1]


def negation(value: Truth) -> Truth:
    """Kleene's not."""
    return UNKNOWN if value is UNKNOWN else not value


def both(first: Truth, second: Truth) -> Truth:
    """Kleene's and."""
    if first is False or second is False:
        return False
    return UNKNOWN if first is UNKNOWN or second is UNKNOWN else True
