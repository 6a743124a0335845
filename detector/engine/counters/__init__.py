"""Counters of every drop, unknown and error, by cause."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from detector.engine.counters.ages import Ages
from wayside.expressions import Reason

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
    """The newest of these times, in nanoseconds on the engine's time axis."""
    time_ns: int = 0
    """Time spent on its evaluation, by the engine's stopwatch."""

    crowded_pairs: int = 0
    """Pairs within reach that exceeded `maxPairs` and were skipped; counted at each evaluation."""

    unfollowed: int = 0
    """Parameters with `follow` that kept their last value because the new one was unknown or failed; counted at each
    evaluation."""
    last_unfollowed: str = ""
    ages: Ages | None = None
    """The age of the samples that it used; None if not measured."""
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
    """The key of the last one, and the invalid name in its message, by stream."""
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
