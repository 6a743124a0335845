"""The steps of the engine: samples to insert, ticks to evaluate, gaps. A time axis makes them from arrivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from detector.engine.samples.sample import Arrival


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
