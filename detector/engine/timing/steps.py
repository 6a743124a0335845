"""The steps of the engine: samples to insert, ticks to evaluate, gaps. A time axis makes them from arrivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from detector.engine.samples.sample import Arrival

ORDER = 2
"""The time-order version of an engine. It is the `version` of an intake file, so that the file replays as it was
recorded.

A file without a version has order 1. There, with clock Data and a lateness of zero, a tick runs with the first stamp of
its time; with clock Wall, samples received during a stall are evaluated at their own times, after the gap. `distance`
and `closingSpeed` have the exact values of that version; the second over which `closingSpeed` is computed ends now, at
any age of the places.
"""


@dataclass(frozen=True, slots=True)
class Insert:
    """Samples to insert, with their times."""

    arrivals: Sequence[Arrival]
    times: Sequence[int] | None
    """None: the receive times."""


@dataclass(frozen=True, slots=True)
class Tick:
    """Evaluate the rules that are due at this time."""

    time: int
    sampled: Sequence[Arrival] = ()
    """The samples of exactly this time whose streams trigger evaluations."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Time continues at `time`, later or earlier, without ticks between."""

    time: int
    backwards: bool


Step = Insert | Tick | Gap
