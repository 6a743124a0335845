"""When an episode starts and ends, for one subject of one rule: a small state machine over Kleene's logic.

    resting ──cooldown over──▶ idle ──condition holds──▶ pending ──for as long as `for`──▶ open ──end──▶ resting

Nothing starts or ends while the condition is unknown. An unknown that lasts longer than `for` resets the onset, and one
that lasts as long as `unknownTimeout` ends an open episode.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from wayside.expressions import UNKNOWN, Unknown

Truth = bool | Unknown


class Reason(StrEnum):
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
    """What the rule says of the subject at one tick."""

    in_scope: Truth
    near: Truth
    """Whether an episode may start at all (a pair within reach)."""
    when: Truth
    until: Truth


@dataclass(frozen=True, slots=True)
class Started:
    """An episode started; the condition has held since `onset`."""

    onset: int


@dataclass(frozen=True, slots=True)
class Ended:
    """The open episode ended."""

    reason: Reason


@dataclass(slots=True)
class SubjectState:
    """Where a subject stands. Times are nanoseconds."""

    is_open: bool = False
    onset: int | None = None
    unknown_since: int | None = None
    rests_until: int = 0

    def idle_at(self, now: int) -> bool:
        """Whether the state says no more than a fresh one would."""
        return not self.is_open and self.onset is None and self.rests_until <= now

    def wake(self, now: int, timing: Timing) -> int | None:
        """When one of its times is over, so that something may happen without a sample; nanoseconds, after `now`."""
        times = []
        if self.is_open:
            if self.unknown_since is not None:
                times.append(self.unknown_since + timing.unknown_timeout)
        elif self.onset is not None:
            times.append(self.onset + timing.hold)
            if self.unknown_since is not None:
                times.append(self.unknown_since + timing.hold + 1)
        else:
            times.append(self.rests_until)
        return min((time for time in times if time > now), default=None)

    def gap(self) -> None:
        """Time went on without us: what was pending is forgotten, an open episode holds."""
        self.onset = None
        self.unknown_since = None

    def end(self, now: int, timing: Timing) -> None:
        """Close the episode; the subject rests."""
        self.is_open = False
        self.onset = None
        self.unknown_since = None
        self.rests_until = now + timing.cooldown

    def step(self, now: int, timing: Timing, seen: Observation) -> Started | Ended | None:
        """Go on to the tick `now`; returns what happened."""
        return self._open_step(now, timing, seen) if self.is_open else self._idle_step(now, timing, seen)

    def _open_step(self, now: int, timing: Timing, seen: Observation) -> Ended | None:
        reason = None
        if seen.in_scope is False:
            reason = Reason.OUT_OF_SCOPE
        elif seen.until is True:
            reason = Reason.UNTIL
        elif seen.until is UNKNOWN:
            if self.unknown_since is None:
                self.unknown_since = now
            if now - self.unknown_since >= timing.unknown_timeout:
                reason = Reason.UNKNOWN
        else:
            self.unknown_since = None
        if reason is None:
            return None
        self.end(now, timing)
        return Ended(reason)

    def _idle_step(self, now: int, timing: Timing, seen: Observation) -> Started | None:
        condition = both(both(seen.in_scope, seen.near), both(seen.when, negation(seen.until)))
        if condition is False:
            self.onset = self.unknown_since = None
            return None
        if condition is UNKNOWN:
            if self.onset is not None:
                if self.unknown_since is None:
                    self.unknown_since = now
                if now - self.unknown_since > timing.hold:
                    self.onset = self.unknown_since = None
            return None
        self.unknown_since = None
        if self.onset is None:
            if now < self.rests_until:
                return None
            self.onset = now
        if now - self.onset < timing.hold:
            return None
        onset, self.onset = self.onset, None
        self.is_open = True
        return Started(onset)


def negation(value: Truth) -> Truth:
    """Kleene's not."""
    return UNKNOWN if value is UNKNOWN else not value


def both(first: Truth, second: Truth) -> Truth:
    """Kleene's and."""
    if first is False or second is False:
        return False
    return UNKNOWN if first is UNKNOWN or second is UNKNOWN else True
