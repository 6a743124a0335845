"""The memory of one run: a row of doubles or booleans for each node, over n points."""

from __future__ import annotations

import enum
import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from wayside.expressions.columns.values import Bools, Bytes, Doubles, Tag

Rows = slice | NDArray[np.intp]
"""The selected rows of an array: a slice if possible, since a slice copies nothing."""

ABSENT: Final = np.uint8(Tag.ABSENT)
NUMBER: Final = np.uint8(Tag.NUMBER)
BOOLEAN: Final = np.uint8(Tag.BOOLEAN)
ONE: Final = np.uint8(1)
THREE: Final = np.uint8(3)


class Array(enum.IntEnum):
    """The array that contains an operand."""

    CONSTANT = 0
    LEAVES = 1
    NUMBERS = 2
    TRUTHS = 3
    MIXED = 4


@dataclass(frozen=True, slots=True)
class Operand:
    """The operand of k operations: k nodes."""

    source: Array
    rows: Rows
    """The rows in that array; for constants, the rows in `values`."""
    partial: bool
    """Whether some node may be unknown even if every leaf is a number."""
    values: Doubles
    """float64[k, 1]: the constants; otherwise empty."""
    tags: Bytes | None
    """uint8[k, 1]: the tags of constants that are not numbers."""


@dataclass(frozen=True, slots=True)
class NodeCounts:
    """The number of nodes of each type."""

    numbers: int
    truths: int
    mixed: int

    def bytes(self, n: int) -> int:
        """The size of a frame for n points."""
        return n * (9 * self.numbers + 2 * self.truths + 9 * self.mixed)


class Memory:
    """Memory for frames, reused once nothing refers to it: new pages take more time than the computation."""

    def __init__(self) -> None:
        self._spare: list[Bytes] = []

    def frame(self, sizes: NodeCounts, values: Doubles, tags: Bytes | None) -> Frame:
        """A frame in memory that no other run uses. Thread-safe."""
        needed = sizes.bytes(values.shape[1])
        try:
            block = self._spare.pop()  # no other thread gets it before it is in use
        except IndexError:
            block = np.empty(needed, np.uint8)
        # Every array within the block refers to it: the results, and arrays that a caller took from them.
        if sys.getrefcount(block) > _UNUSED or not needed <= block.size <= _ROOMY * needed + _SMALL:
            block = np.empty(needed, np.uint8)
        frame = Frame(sizes, values, tags, block)
        self._spare.append(block)
        return frame


_UNUSED: Final = 2
"""The reference count of an unused block: the variable, and the argument of `sys.getrefcount`."""
_ROOMY: Final = 4
_SMALL: Final = 1 << 20


class Frame:
    """The arrays of one run.

    `tagged`: whether any leaf has values other than numbers; otherwise some work is skipped.
    """

    def __init__(self, sizes: NodeCounts, values: Doubles, tags: Bytes | None, block: Bytes) -> None:
        n = values.shape[1]
        self.tagged = tags is not None and not bool((tags == NUMBER).all())
        self.leaves = values
        self.leaf_tags = tags if tags is not None else np.empty((0, n), np.uint8)
        of_numbers, of_truths, of_mixed = (sizes.numbers, n), (sizes.truths, n), (sizes.mixed, n)
        at = 8 * n * (sizes.numbers + sizes.mixed)
        self.numbers: Doubles = np.ndarray(of_numbers, np.float64, block)
        self.mixed: Doubles = np.ndarray(of_mixed, np.float64, block, 8 * n * sizes.numbers)
        self.known: Bools = np.ndarray(of_numbers, np.bool_, block, at)
        self.true: Bools = np.ndarray(of_truths, np.bool_, block, at := at + n * sizes.numbers)
        self.false: Bools = np.ndarray(of_truths, np.bool_, block, at := at + n * sizes.truths)
        self.mixed_tags: Bytes = np.ndarray(of_mixed, np.uint8, block, at + n * sizes.truths)

    @cached_property
    def odd(self) -> bool:
        """Whether any leaf has values other than numbers and absent ones."""
        return self.tagged and bool((self.leaf_tags > NUMBER).any())

    def leaves_with(self, tag: Tag) -> frozenset[int]:
        """The leaves that have this tag at some point."""
        return frozenset(np.flatnonzero((self.leaf_tags == np.uint8(tag)).any(axis=1)).tolist())

    @cached_property
    def leaf_known(self) -> Bools:
        """bool[leaves, n]: whether a leaf is a number."""
        return np.equal(self.leaf_tags, NUMBER)

    def number(self, operand: Operand) -> tuple[Doubles, Bools | None]:
        """The operand's numbers, and whether there is one; None: everywhere."""
        rows = operand.rows
        match operand.source:
            case Array.LEAVES:
                return self.leaves[rows], self.leaf_known[rows] if self.tagged else None
            case Array.NUMBERS:
                return self.numbers[rows], self.known[rows] if self.tagged or operand.partial else None
            case Array.CONSTANT:
                return operand.values, None
        return self.mixed[rows], self.mixed_tags[rows] == NUMBER

    def truth(self, operand: Operand) -> tuple[Bools, Bools]:
        """Whether the operand is true, and whether it is false."""
        rows = operand.rows
        match operand.source:
            case Array.TRUTHS:
                true = self.true[rows]
                return true, self.false[rows] if self.tagged or operand.partial else ~true
            case Array.LEAVES if not self.tagged:
                never = np.zeros((1, self.leaves.shape[1]), bool)
                return never, never
            case Array.LEAVES:
                return _truths(self.leaves[rows], self.leaf_tags[rows])
            case Array.CONSTANT:
                true = operand.values != 0
                return true, ~true
        return _truths(self.mixed[rows], self.mixed_tags[rows])

    def anything(self, operand: Operand) -> tuple[Doubles, Bytes | None]:
        """The operand's values and tags; None: all are numbers."""
        rows = operand.rows
        match operand.source:
            case Array.LEAVES:
                return self.leaves[rows], self.leaf_tags[rows] if self.tagged else None
            case Array.MIXED:
                return self.mixed[rows], self.mixed_tags[rows]
            case Array.CONSTANT:
                return operand.values, operand.tags
            case Array.NUMBERS:
                values, known = self.number(operand)
                return values, None if known is None else known.view(np.uint8)  # True is the tag of a number
        true, false = self.truth(operand)
        return true.astype(np.float64), (true | false).view(np.uint8) * BOOLEAN


def _truths(values: Doubles, tags: Bytes) -> tuple[Bools, Bools]:
    boolean = tags == BOOLEAN
    true = boolean & (values != 0)
    return true, boolean & ~true
