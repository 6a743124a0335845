"""The nodes of a graph of expressions, and the checks for rows that need CEL."""

from __future__ import annotations

import enum
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from wayside.expressions.columns.values import Tag


class NodeType(enum.Enum):
    """The static type of a node's result."""

    NUMBERS = enum.auto()
    TRUTHS = enum.auto()
    TEXTS = enum.auto()
    ANY = enum.auto()
    """The tag of each row defines the type."""


class Op(enum.Enum):
    """The operation of a node."""

    LEAF = enum.auto()
    CONSTANT = enum.auto()
    EXPECT = enum.auto()
    """A leaf whose type the expression declares."""
    ADD = enum.auto()
    SUBTRACT = enum.auto()
    MULTIPLY = enum.auto()
    DIVIDE = enum.auto()
    NEGATE = enum.auto()
    CALL = enum.auto()
    """A function of numbers."""
    LESS = enum.auto()
    LESS_EQUAL = enum.auto()
    EQUAL = enum.auto()
    AND = enum.auto()
    OR = enum.auto()
    NOT = enum.auto()
    HAS = enum.auto()
    CHOOSE = enum.auto()
    """`?:`."""
    NUMBER = enum.auto()
    """The numbers of its operand; other values are unknown."""
    TRUTH = enum.auto()
    TEXT = enum.auto()
    NEVER = enum.auto()
    """Unknown in every row: the boolean of a value that cannot be one."""


COMMUTATIVE = frozenset({Op.ADD, Op.MULTIPLY, Op.EQUAL, Op.AND, Op.OR})
GIVEN = frozenset({Op.LEAF, Op.CONSTANT, Op.EXPECT})
"""Operations that need no calculation."""


@dataclass(frozen=True, slots=True)
class Node:
    """One operation. Its operands have smaller numbers than itself."""

    op: Op
    holds: NodeType
    operands: tuple[int, ...]
    detail: Hashable = None
    """A leaf's name, a constant's value, the expected tag, or a function's name, number of arguments and place."""
    depth: int = 0


class Nodes:
    """The nodes that the expressions of all rules share: equal operations on equal operands are one node."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._numbers: dict[Hashable, int] = {}

    def leaf(self, name: Hashable) -> int:
        """The node of a leaf."""
        return self.node(Op.LEAF, NodeType.ANY, detail=name)

    def truth(self, node: int) -> int:
        """The node's rows as booleans: a row of another type is unknown."""
        match self.nodes[node]:
            case Node(Op.CONSTANT, NodeType.TRUTHS) | Node(holds=NodeType.ANY):
                return self.node(Op.TRUTH, NodeType.TRUTHS, (node,))
            case Node(holds=NodeType.TRUTHS):
                return node
        return self.node(Op.NEVER, NodeType.TRUTHS, (node,))

    def constant(self, value: bool | float | str) -> int:
        """The node of a literal."""
        if isinstance(value, bool):
            return self.node(Op.CONSTANT, NodeType.TRUTHS, detail=value)
        if isinstance(value, str):
            return self.node(Op.CONSTANT, NodeType.TEXTS, detail=value)
        return self.node(Op.CONSTANT, NodeType.NUMBERS, detail=float(value))

    def node(self, op: Op, holds: NodeType, operands: Sequence[int] = (), detail: Hashable = None) -> int:
        """The number of this node. It is created if it does not exist."""
        operands = tuple(sorted(operands) if op in COMMUTATIVE else operands)
        named = detail.hex() if isinstance(detail, float) and op is Op.CONSTANT else detail  # 0.0 is not -0.0
        key = (op, holds, operands, named)
        found = self._numbers.get(key)
        if found is None:
            depth = 0 if op in GIVEN else 1 + max((self.nodes[each].depth for each in operands), default=0)
            found = self._numbers[key] = len(self.nodes)
            self.nodes.append(Node(op, holds, operands, detail, depth))
        return found

    def forget(self, count: int) -> None:
        """Removes all nodes but the first `count`."""
        del self.nodes[count:]
        self._numbers = {key: number for key, number in self._numbers.items() if number < count}

    def checks(self, node: int) -> tuple[CelCheck, ...]:
        """The checks for rows that columns cannot decide because of this node."""
        here = self.nodes[node]
        if here.op is Op.EXPECT and isinstance(here.detail, Tag):
            return (CelCheck(RowsForCel.UNEXPECTED, here.operands, here.detail),)
        anything = [self._leaf_of(each) for each in here.operands if self.nodes[each].holds is NodeType.ANY]
        found = (
            []
            if here.op in (Op.CHOOSE, Op.HAS)
            else [CelCheck(RowsForCel.OTHER, (each,)) for each in dict.fromkeys(anything)]
        )
        if here.op in (Op.ADD, Op.LESS, Op.LESS_EQUAL) and len(anything) == 2:
            found.append(CelCheck(RowsForCel.TEXTS, (anything[0], anything[1])))
        return tuple(found)

    def _leaf_of(self, node: int) -> int:
        """The leaf of an EXPECT node; any other node itself."""
        here = self.nodes[node]
        return here.operands[0] if here.op is Op.EXPECT else node


class RowsForCel(enum.Enum):
    """The rows that CEL has to decide."""

    OTHER = enum.auto()
    """Those with a value whose tag is OTHER."""
    TEXTS = enum.auto()
    """Those in which both values are strings: CEL compares and concatenates them."""
    UNEXPECTED = enum.auto()
    """Those with a value of another type than declared: CEL converts some of these."""


class CelCheck(NamedTuple):
    """A check of one or two nodes for rows that CEL has to decide."""

    rows: RowsForCel
    nodes: tuple[int, ...]
    expected: Tag = Tag.NUMBER
