"""Who looks on while rules are evaluated in columns. It decides nothing, and nothing is computed for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from detector.engine.columns.block import Block, Track
from detector.engine.columns.fleets import FleetBlock
from detector.engine.columns.pairs import Sight
from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Codes


class Observer(Protocol):
    """Gets each block as it was evaluated. What it keeps of it, it copies."""

    def clients(self, tracks: Sequence[Track], block: Block, codes: Codes, looked: Truths | None) -> None:
        """Rules about clients: the observations have shape (tracks, clients, ticks), `looked` (tracks, clients).

        The block has the signals and, by field, where conditions are true and false (`verdicts`), one row a track.
        """

    def fleet(self, tracks: Sequence[Track], block: FleetBlock) -> None:
        """Rules about the fleet: the block has its members and the conditions of each track."""

    def pairs(self, track: Track, sight: Sight) -> None:
        """A rule about pairs at one tick."""
