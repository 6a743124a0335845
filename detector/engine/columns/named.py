"""Signals that name the client whose samples they aggregate: computed for that client only, and used for all others."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from wayside.expressions.columns.values import Column, Tag


class Computed(Protocol):
    """Computes the signals of one client."""

    def compute(self, block: Block, floor: int | None) -> None:
        """Compute all signals of a block that contains only this client."""

    def place(self, row: int, name: str) -> int:
        """The index of a track's signal among the signals of the client."""


class NamedSignals:
    """The signals of a group that name one client."""

    def __init__(self, client: str) -> None:
        self.client = client
        self.columns: Computed | None = None
        """Set when all signals have an index."""
        self._places: list[tuple[int, Track, str]] = []

    def add(self, at: int, track: Track, name: str) -> None:
        """Add a track's signal that names a client, with its index in the group."""
        self._places.append((at, track, name))

    def compute(self, context: Context, block: Block, floor: int | None) -> dict[int, Column]:
        """The signals at all points of a block, by their indices; unknown while the client is not known."""
        known = np.array([context.clients.knows(self.client, tick) for tick in block.ticks], bool)
        own = Block(context, block.ticks, (self.client,)) if known.any() else None
        if own is not None:
            assert self.columns is not None  # noqa: S101  all signals were placed
            own.present = known[None, :]
            self.columns.compute(own, floor)
        # Which ticks without clients are in a block depends on how blocks are cut.
        read = np.full(len(known), bool(block.clients)) if block.present is None else block.present.any(axis=0)
        found: dict[int, Column] = {}
        for at, track, name in self._places:
            track.counters.unknowns += int((~known & read).sum())
            column = Column(np.zeros(len(known)), np.zeros(len(known), np.uint8), None)
            if own is not None and self.columns is not None:
                column = own.signals[self.columns.place(track.row, name)]
            found[at] = _repeated(column, known, len(block.clients))
        return found


def _repeated(column: Column, known: np.ndarray[tuple[int], np.dtype[np.bool_]], times: int) -> Column:
    """The column for each of these clients, where it is known."""
    tags = np.full(len(known), Tag.NUMBER, np.uint8) if column.tags is None else column.tags
    return Column(
        np.tile(column.values, times),
        None if column.tags is None and known.all() else np.tile(np.where(known, tags, Tag.ABSENT), times),
        None if column.others is None else np.tile(column.others, times),
    )
