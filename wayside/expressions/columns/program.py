"""Groups the nodes of a graph into steps, runs them over rows, and returns the results of the roots.

Nodes of the same depth with the same operation are one step, for all rules together. So a run takes a few numpy calls
per depth and operation, independent of the number of rules and rows.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from wayside.expressions.columns.cel_fallback import CelChecks, CelRows
from wayside.expressions.columns.frame import ABSENT, NUMBER, Array, Frame, Memory, NodeCounts, Operand, Rows
from wayside.expressions.columns.functions import Called
from wayside.expressions.columns.nodes import GIVEN, Node, Nodes, NodeType, Op
from wayside.expressions.columns.operations import UNKNOWN_OF_NUMBERS, Step
from wayside.expressions.columns.values import Bools, Bytes, Column, Doubles, Tag, Texts

_SOURCES: Final = {NodeType.NUMBERS: Array.NUMBERS, NodeType.TRUTHS: Array.TRUTHS, NodeType.ANY: Array.MIXED}
_NO_DOUBLES: Final = np.zeros((0, 1))
_CACHE_SIZE: Final = 256
_Scalar = TypeVar("_Scalar", bound=np.generic)
_TAGS: Final[dict[type, Tag]] = {bool: Tag.BOOLEAN, str: Tag.TEXT}


class Program:
    """The steps that compute some nodes of a graph, the roots. It does not change when the graph grows."""

    leaves: tuple[Hashable, ...]
    """The names of the leaves, in the order of the rows of the arguments of `run`."""

    def __init__(self, graph: Nodes, roots: Sequence[int], texts: Texts) -> None:
        self._nodes = graph.nodes
        self._texts = texts
        wanted = sorted(_reachable(graph, roots))
        leaves = [number for number in wanted if self._nodes[number].op is Op.LEAF]
        self.leaves = tuple(self._nodes[number].detail for number in leaves)
        self._places: dict[int, tuple[Array, int]] = {leaf: (Array.LEAVES, row) for row, leaf in enumerate(leaves)}
        self._partial: dict[int, bool] = {}
        for number in wanted:
            node = self._nodes[number]
            self._partial[number] = self._is_partial(node)
            if node.op is Op.CONSTANT:
                self._places[number] = (Array.CONSTANT, 0)
            elif node.op is Op.EXPECT:
                self._places[number] = self._places[node.operands[0]]
        self._steps, self._sizes = self._put_into_steps(wanted)
        self._checks = CelChecks(graph, roots, self._places)
        self._memory = Memory()
        self._rows: dict[tuple[int, ...], Operand] = {}

    def run(self, values: Doubles, tags: Bytes | None) -> Results:
        """Evaluates every root for n rows.

        `values` is float64[len(leaves), n] and `tags` uint8[len(leaves), n], as in `Column`; None: all are numbers.
        Neither may change while the results are in use.
        """
        frame = self._memory.frame(self._sizes, values, tags)
        with np.errstate(all="ignore"):
            for step in self._steps:
                step(frame)
        return Results(self, frame, self._checks)

    def operand(self, roots: Sequence[int]) -> Operand:
        """Nodes of the program that are in one array, as one operand.

        Raises KeyError for a node that the program does not have, and ValueError for nodes in several arrays.
        """
        key = tuple(roots)
        found = self._rows.get(key)
        if found is None:
            if len({self._places[root][0] for root in key}) != 1:
                raise ValueError("the roots have different types: evaluate each separately")
            if len(self._rows) >= _CACHE_SIZE:
                self._rows.clear()
            found = self._rows[key] = self._operand(key)
        return found

    def partial(self, roots: Sequence[int]) -> Bools:
        """bool[len(roots), 1]: whether each node may be unknown even if every leaf is a number."""
        return np.array([[self._partial[root]] for root in roots])

    def _is_partial(self, node: Node) -> bool:
        """Whether the node may be unknown, or of the wrong type, even if all leaves are numbers."""
        if node.op in UNKNOWN_OF_NUMBERS:
            return True
        operands = [self._nodes[each].holds for each in node.operands]
        match node.op:
            case Op.CHOOSE:
                typed = node.holds is not NodeType.ANY and operands[0] is NodeType.TRUTHS
            case Op.AND | Op.OR | Op.NOT:
                typed = NodeType.ANY not in operands
            case Op.LESS | Op.LESS_EQUAL:
                typed = set(operands) != {NodeType.ANY, NodeType.TRUTHS}
            case _:
                typed = True
        return not typed or any(self._partial[each] for each in node.operands)

    def _put_into_steps(self, wanted: Sequence[int]) -> tuple[list[Step], NodeCounts]:
        groups: dict[tuple[object, ...], list[int]] = {}
        depths: dict[int, list[tuple[object, ...]]] = {}
        for number in wanted:
            node = self._nodes[number]
            if node.op in GIVEN:
                continue
            key: tuple[object, ...] = (
                node.depth,
                node.op,
                node.holds,
                node.detail,
                self._partial[number],
                self._shape(node),
            )
            if key not in groups:
                depths.setdefault(node.depth, []).append(key)
            groups.setdefault(key, []).append(number)
        steps: list[Step] = []
        counts = dict.fromkeys(_SOURCES.values(), 0)
        for depth in sorted(depths):
            for key in depths[depth]:
                numbers = sorted(groups[key], key=lambda each: [self._places[o] for o in self._nodes[each].operands])
                steps.append(self._step(numbers, counts))
        return steps, NodeCounts(counts[Array.NUMBERS], counts[Array.TRUTHS], counts[Array.MIXED])

    def _shape(self, node: Node) -> tuple[object, ...]:
        """The common properties of the operands of the nodes in one step."""
        operands = [self._nodes[each] for each in node.operands]
        return tuple(
            (
                operand.op is Op.CONSTANT,
                operand.op in (Op.LEAF, Op.EXPECT),
                operand.holds,
                self._partial[number],
            )
            for number, operand in zip(node.operands, operands, strict=True)
        )

    def _step(self, numbers: Sequence[int], counts: dict[Array, int]) -> Step:
        node = self._nodes[numbers[0]]
        operands = tuple(
            self._operand([self._nodes[number].operands[position] for number in numbers])
            for position in range(len(node.operands))
        )
        into = _SOURCES[node.holds]
        first = counts[into]
        counts[into] += len(numbers)
        self._places |= {number: (into, first + row) for row, number in enumerate(numbers)}
        function: Called = node.detail if node.op is Op.CALL and isinstance(node.detail, tuple) else ("", 0)
        return Step(node.op, operands, slice(first, counts[into]), self._partial[numbers[0]], into, function)

    def _operand(self, numbers: Sequence[int]) -> Operand:
        source, _ = self._places[numbers[0]]
        partial = any(self._partial[number] for number in numbers)
        if source is not Array.CONSTANT:
            return Operand(source, _rows([self._places[number][1] for number in numbers]), partial, _NO_DOUBLES, None)
        details = [self._nodes[number].detail for number in numbers]
        values = np.array([[self._double(each)] for each in details])
        tag = _TAGS.get(type(details[0]))
        tags = None if tag is None else np.full(values.shape, tag, np.uint8)
        return Operand(source, slice(None), False, values, tags)

    def _double(self, value: Hashable) -> float:
        return float(self._texts.code(value)) if isinstance(value, str) else float(value)  # type: ignore[arg-type]


def _reachable(graph: Nodes, roots: Sequence[int]) -> set[int]:
    found: set[int] = set()
    pending = list(roots)
    while pending:
        number = pending.pop()
        if number not in found:
            found.add(number)
            pending += graph.nodes[number].operands
    return found


def _rows(rows: Sequence[int]) -> Rows:
    """The rows as a slice if they have equal distances, or are all the same."""
    first = rows[0]
    if len(set(rows)) == 1:
        return slice(first, first + 1)
    step = rows[1] - first
    if step > 0 and all(row == first + step * number for number, row in enumerate(rows)):
        return slice(first, rows[-1] + 1, step)
    return np.array(rows, np.intp)


def _spread(array: NDArray[_Scalar], shape: tuple[int, ...]) -> NDArray[_Scalar]:
    return array if array.shape == shape else np.broadcast_to(array, shape)


class Results:
    """The results of the roots for the n rows of a run."""

    __slots__ = ("_checks", "_found", "_frame", "_program")

    def __init__(self, program: Program, frame: Frame, checks: CelChecks) -> None:
        self._program = program
        self._frame = frame
        self._checks = checks
        self._found: CelRows | None = None

    def truths(self, roots: Sequence[int]) -> tuple[Bools, Bools]:
        """bool[len(roots), n] twice: whether each root is true, and whether it is false; neither: unknown.

        The roots must be results of `Graph.truth`. Raises KeyError for a root that the program does not have, and
        ValueError for one that is not boolean.
        """
        n = self._frame.leaves.shape[1]
        if not roots:
            return np.zeros((0, n), bool), np.zeros((0, n), bool)
        operand = self._program.operand(roots)
        if operand.source is not Array.TRUTHS:
            raise ValueError("the roots are not boolean: use the nodes that Graph.truth returns for them")
        true, false = self._frame.truth(operand)
        if operand.partial and not self._frame.tagged:  # `false` is not filled for the others
            false = np.where(self._program.partial(roots), false, ~true)
        shape = (len(roots), n)
        return _spread(true, shape), _spread(false, shape)

    def column(self, root: int) -> Column:
        """The values of a root. NaN, the result of 0/0, is absent.

        A leaf has its input, without the values tagged OTHER.
        """
        n = self._frame.leaves.shape[1]
        several, several_tags = self._frame.anything(self._program.operand((root,)))
        values = _spread(several[0], (n,))
        tags = None if several_tags is None else _spread(several_tags[0], (n,))
        absent = np.isnan(values)
        if absent.any():
            tags = np.where(absent, ABSENT, NUMBER if tags is None else tags)
            values = np.where(absent, 0.0, values)
        return Column(values, tags)

    def cel_rows(self, root: int) -> Bools | None:
        """bool[n]: the rows that CEL has to decide, because the columns cannot; None: no row.

        In these rows, two strings are concatenated or compared by order, a value tagged OTHER is used by anything
        but `has()`, or a variable has another type than its environment declares.
        """
        if self._found is None:
            self._found = self._checks.find(self._frame)
        return self._checks.rows(root, self._found) if self._found else None
