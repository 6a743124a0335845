"""Lowers the syntax tree of an expression to nodes of the graph. Refuses expressions that only CEL can evaluate."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping
from typing import Final, NamedTuple

from wayside.expressions.cel import CelType, Expression
from wayside.expressions.columns.functions import about_place, takes_columns
from wayside.expressions.columns.nodes import Nodes, NodeType, Op
from wayside.expressions.columns.values import Tag
from wayside.expressions.projection import integer
from wayside.expressions.syntax import Call, Collection, Node, Path, Scalar, Select, path_of
from wayside.geo.geometry import shape_of

_ARITHMETIC: Final = {"_+_": Op.ADD, "_-_": Op.SUBTRACT, "_*_": Op.MULTIPLY, "_/_": Op.DIVIDE}
_ORDER: Final = {"_<_": (Op.LESS, False), "_<=_": (Op.LESS_EQUAL, False)} | {
    "_>_": (Op.LESS, True), "_>=_": (Op.LESS_EQUAL, True),
}  # fmt: skip
"""The operation, and whether its operands are swapped."""
_DECLARED: Final = {CelType.DOUBLE: Tag.NUMBER, CelType.BOOL: Tag.BOOLEAN, CelType.STRING: Tag.TEXT}
_MOST_ELEMENTS: Final = 256
"""The maximum length of a list after `in`: each element is one comparison per row."""


class Constant(NamedTuple):
    """A value instead of a leaf, the same for every row."""

    value: bool | float | str


class LoweringError(Exception):
    """The columns cannot evaluate this expression."""


class Part(NamedTuple):
    """A part of an expression, or an expression that is composed of parts."""

    tree: Node
    kinds: Mapping[str, CelType]
    """The types of the variables that it may read."""
    result: CelType

    @property
    def names(self) -> frozenset[str]:
        """The variables that it may read."""
        return frozenset(self.kinds)


Leaves = Callable[[Path], Hashable | Constant | None]
"""The leaf of a path, a constant instead of it, or None if there is no such column."""


class _Lowering:
    def __init__(self, graph: Nodes, expression: Expression | Part, leaf: Leaves) -> None:
        self._graph = graph
        self._expression = expression
        self._tree = expression.tree
        self._leaf = leaf
        self._names = expression.names

    def root(self) -> int:
        """The node of the result, checked against the result type of the expression.

        Raises LoweringError if there is no node.
        """
        found = self._lower(self._tree)
        holds = self._holds(found)
        match self._expression.result, holds:
            case (CelType.DYN, _) | (CelType.DOUBLE, NodeType.NUMBERS) | (CelType.STRING, NodeType.TEXTS):
                return found
            case CelType.BOOL, _:
                return self._graph.truth(found)
            case CelType.DOUBLE, NodeType.ANY:
                return self._graph.node(Op.NUMBER, NodeType.NUMBERS, (found,))
            case CelType.STRING, NodeType.ANY:
                return self._graph.node(Op.TEXT, NodeType.ANY, (found,))
        raise LoweringError

    def _holds(self, node: int) -> NodeType:
        return self._graph.nodes[node].holds

    def _lower(self, node: Node) -> int:
        path = path_of(node, self._names)
        if path is not None and not (isinstance(node, Select) and node.test_only):
            return self._given(path)
        match node:
            case Scalar(bool() | float() | str() as value):
                return self._constant(value)
            case Select(_, _, True) if path is not None:
                return self._has(path)
            case Call("_&&_" | "_||_" as name, None, (a, b)):
                return self._graph.node(
                    Op.AND if name == "_&&_" else Op.OR, NodeType.TRUTHS, (self._truth(a), self._truth(b))
                )
            case Call("!_", None, (a,)):
                return self._not(self._truth(a))
            case Call("-_", None, (a,)):
                return self._graph.node(Op.NEGATE, NodeType.NUMBERS, (self._number(a),))
            case Call(name, None, (a, b)) if name in _ARITHMETIC:
                return self._graph.node(_ARITHMETIC[name], NodeType.NUMBERS, (self._number(a), self._number(b)))
            case Call(name, None, (a, b)) if name in _ORDER:
                return self._order(name, a, b)
            case Call("_==_", None, (a, b)):
                return self._equal(a, b)
            case Call("_!=_", None, (a, b)):
                return self._not(self._equal(a, b))
            case Call("@in", None, (a, Collection(False, elements))):
                return self._in(a, elements)
            case Call("_?_:_", None, (condition, a, b)):
                return self._choose(condition, a, b)
            case Call(name, None, (*given, Scalar(str() as key))) if about_place(name):
                return self._graph.node(
                    Op.CALL,
                    NodeType.NUMBERS,
                    tuple(self._number(each) for each in given),
                    (name, len(given), shape_of(key)),
                )
            case Call(name, None, given) if takes_columns(name, len(given)):
                return self._graph.node(
                    Op.CALL, NodeType.NUMBERS, tuple(self._number(each) for each in given), (name, len(given))
                )
        raise LoweringError

    def _given(self, path: Path) -> int:
        found = self._named(path)
        kind = self._expression.kinds[str(path[0])] if len(path) == 1 else CelType.DYN
        if isinstance(found, Constant):
            expected = {bool: CelType.BOOL, str: CelType.STRING}.get(type(found.value), CelType.DOUBLE)
            if kind not in (CelType.DYN, expected):
                raise LoweringError
            return self._constant(found.value.replace("\0", "␀") if isinstance(found.value, str) else found.value)
        node = self._graph.leaf(found)
        if kind is CelType.DYN:
            return node
        if kind not in _DECLARED:
            raise LoweringError
        return self._graph.node(Op.EXPECT, NodeType.ANY, (node,), _DECLARED[kind])

    def _named(self, path: Path) -> Hashable | Constant:
        found = self._leaf(path)
        if found is None:
            raise LoweringError
        return found

    def _constant(self, value: bool | float | str) -> int:
        if isinstance(value, str):
            _check_text(value)
        elif math.isnan(value) or (type(value) is int and type(integer(value)) is int):
            raise LoweringError
        return self._graph.constant(value)

    def _has(self, path: Path) -> int:
        found = self._named(path)
        if isinstance(found, Constant):
            return self._graph.constant(True)
        # Bytes that the expression also compares by order are absent everywhere in it; the comparison marks their rows.
        return self._graph.node(Op.HAS, NodeType.TRUTHS, (self._graph.leaf(found),))

    def _number(self, node: Node) -> int:
        found = self._lower(node)
        if self._holds(found) not in (NodeType.NUMBERS, NodeType.ANY):
            raise LoweringError
        return found

    def _truth(self, node: Node) -> int:
        found = self._lower(node)
        return found if self._holds(found) in (NodeType.TRUTHS, NodeType.ANY) else self._graph.truth(found)

    def _not(self, node: int) -> int:
        return self._graph.node(Op.NOT, NodeType.TRUTHS, (node,))

    def _order(self, name: str, a: Node, b: Node) -> int:
        op, turned = _ORDER[name]
        first, second = self._lower(a), self._lower(b)
        kinds = {self._holds(first), self._holds(second)}
        if NodeType.TEXTS in kinds or kinds == {NodeType.NUMBERS, NodeType.TRUTHS}:
            raise LoweringError
        return self._graph.node(op, NodeType.TRUTHS, (second, first) if turned else (first, second))

    def _equal(self, a: Node, b: Node) -> int:
        self._check_not_null(a)
        self._check_not_null(b)
        return self._graph.node(Op.EQUAL, NodeType.TRUTHS, (self._lower(a), self._lower(b)))

    def _in(self, sought: Node, elements: tuple[Node, ...]) -> int:
        literals = [each.value for each in elements if isinstance(each, Scalar)]
        if not elements or len(literals) < len(elements) or len(elements) > _MOST_ELEMENTS:
            raise LoweringError
        self._check_not_null(sought)
        what = self._lower(sought)
        found: list[int] = []
        for value in literals:
            if not isinstance(value, bool | float | str):
                raise LoweringError
            found.append(self._graph.node(Op.EQUAL, NodeType.TRUTHS, (what, self._constant(value))))
        while len(found) > 1:  # as a balanced tree, so that it is not deep
            rest = found[len(found) & ~1 :]
            found = [
                self._graph.node(Op.OR, NodeType.TRUTHS, pair) for pair in zip(found[::2], found[1::2], strict=False)
            ]
            found += rest
        return found[0]

    def _choose(self, condition: Node, a: Node, b: Node) -> int:
        test, first, second = self._truth(condition), self._lower(a), self._lower(b)
        kinds = {self._holds(first), self._holds(second)}
        holds = kinds.pop() if kinds in ({NodeType.NUMBERS}, {NodeType.TRUTHS}) else NodeType.ANY
        return self._graph.node(Op.CHOOSE, holds, (test, first, second))

    def _check_not_null(self, node: Node) -> None:
        """Refuses an item of a list: it can be null, which a column cannot distinguish from an absent value."""
        match node:
            case Call("_?_:_", None, (_, a, b)):
                self._check_not_null(a)
                self._check_not_null(b)
            case _:
                path = path_of(node, self._names)
                if path is not None and isinstance(path[-1], int):
                    raise LoweringError


def _check_text(text: str) -> None:
    if "\0" in text:
        raise LoweringError
    try:
        text.encode()
    except UnicodeEncodeError:
        raise LoweringError from None


class Graph(Nodes):
    """Nodes that the expressions of all rules share: equal operations on equal operands are one node."""

    def add(self, expression: Expression | Part, leaf: Leaves) -> int | None:
        """The node of the expression's result. None if the columns cannot evaluate it; the graph is then unchanged.

        `leaf` names each literal path that the expression reads: the same name is the same leaf for all expressions.
        It may return a Constant instead, or None if there is no such column.
        """
        before = len(self.nodes)
        try:
            return _Lowering(self, expression, leaf).root()
        except LoweringError:
            self.forget(before)
            return None
