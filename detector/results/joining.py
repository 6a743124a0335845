"""Joins consecutive small blocks: numpy costs as much for a few points as for thousands."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from detector.engine.columns.block import Block
from detector.engine.columns.verdicts import Codes
from detector.results.series import Integers
from wayside.expressions.columns.values import Bools, Column, Tag


class EvaluatedBlock(NamedTuple):
    """An evaluated block, and the numbers of its clients."""

    block: Block
    codes: Codes
    numbers: Integers


class JoinedBlock:
    """Consecutive blocks of the same clients as one block."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        """At least one."""
        self._blocks = blocks
        self._starts = [0, *itertools.accumulate(len(block.ticks) for block in blocks)]
        self.ticks: Sequence[int] = [tick for block in blocks for tick in block.ticks]
        self.times: Integers = np.concatenate([block.times for block in blocks])
        self.shape = (len(blocks[0].clients), len(self.ticks))
        self.signals = [self._column(at) for at in range(len(blocks[0].signals))]
        self.present = self._present()
        self.verdicts = {
            field: tuple(self._joined([block.verdicts[field][side] for block in blocks]) for side in (0, 1))
            for field in blocks[0].verdicts
        }

    def at(self, point: int) -> tuple[Block, int]:
        """The block that contains a point, and the point's index in it."""
        client, tick = divmod(point, len(self.ticks))
        place = bisect_right(self._starts, tick) - 1
        block = self._blocks[place]
        return block, client * len(block.ticks) + tick - self._starts[place]

    def _column(self, at: int) -> Column:
        columns = [block.signals[at] for block in self._blocks]
        if len(columns) == 1:
            return columns[0]
        values = self._along([column.values for column in columns])
        if all(column.tags is None for column in columns):
            return Column(values, None)
        tags = [
            np.full(column.values.shape, Tag.NUMBER, np.uint8) if column.tags is None else column.tags
            for column in columns
        ]
        return Column(values, self._along(tags).astype(np.uint8))

    def _along(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Concatenates flat arrays over the points of the blocks."""
        clients = self.shape[0]
        return np.concatenate([part.reshape(clients, -1) for part in parts], axis=1).ravel()

    def _joined(self, parts: Sequence[Bools]) -> Bools:
        """The same for arrays with a row per track."""
        if len(parts) == 1:
            return parts[0]
        rows, clients = len(parts[0]), self.shape[0]
        return np.concatenate([part.reshape(rows, clients, -1) for part in parts], axis=2).reshape(rows, -1)

    def _present(self) -> Bools | None:
        if all(block.present is None for block in self._blocks):
            return None
        parts = [
            np.ones((len(block.clients), len(block.ticks)), bool) if block.present is None else block.present
            for block in self._blocks
        ]
        return np.concatenate(parts, axis=1)


class Joined(NamedTuple):
    """Blocks as one."""

    block: JoinedBlock
    codes: Codes
    numbers: Integers


def joined_blocks(waiting: Sequence[EvaluatedBlock]) -> Iterator[Joined]:
    """The blocks, with those of the same clients joined."""
    for _, group in itertools.groupby(waiting, key=lambda each: each.numbers.tobytes()):
        parts = [*group]
        codes = parts[0].codes if len(parts) == 1 else np.concatenate([part.codes for part in parts], axis=2)
        yield Joined(JoinedBlock([part.block for part in parts]), codes, parts[0].numbers)
