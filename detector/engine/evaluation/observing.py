"""Observers of an engine. They influence no result, and nothing is computed only for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from detector.engine.columns.block import Block, Track
from detector.engine.columns.fleets import FleetBlock
from detector.engine.columns.pairs import PairBlock
from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Codes
from detector.engine.episodes.demands import DemandChange


class Observer(Protocol):
    """Receives each block that was evaluated in columns, and copies what it keeps."""

    def clients(self, tracks: Sequence[Track], block: Block, codes: Codes, selected: Truths | None) -> None:
        """Rules about clients: the observations have shape (tracks, clients, ticks), `selected` (tracks, clients).

        The block has the signals and, by field, where conditions are true and false (`verdicts`), one row per track.
        """

    def fleet(self, tracks: Sequence[Track], block: FleetBlock) -> None:
        """Rules about the fleet: the block has its members and the conditions of each track."""

    def pairs(self, track: Track, these: PairBlock) -> None:
        """A rule about pairs at one tick."""


@dataclass
class Observers:
    """The observers; all are off by default."""

    stopwatch: Callable[[], int] = int
    """Returns nanoseconds of any running clock, for the counters."""
    journal: list[DemandChange] | None = None
    """Changes of demands, in order."""
    observer: Observer | None = None
