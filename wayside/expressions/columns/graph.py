"""The graph of all rules' expressions: a node for each operation, and one node for what several expressions share."""

from __future__ import annotations

from wayside.expressions.cel import Expression
from wayside.expressions.columns.lowering import Leaves, LoweringError, Part, lower
from wayside.expressions.columns.nodes import Nodes


class Graph(Nodes):
    """Nodes that the expressions of all rules share: equal operations on equal operands are one node."""

    def add(self, expression: Expression | Part, leaf: Leaves) -> int | None:
        """The node of the expression's result; None where the columns cannot take it, and the graph stays as it was.

        `leaf` names each literal path that the expression reads: the same name is the same leaf for all expressions.
        It may give a Constant in its place, or None if there is no such column.
        """
        before = len(self.nodes)
        try:
            return lower(self, expression, leaf)
        except LoweringError:
            self.forget(before)
            return None
