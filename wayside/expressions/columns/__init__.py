"""CEL expressions over columns: evaluates many rules on many rows at once, with the same results as CEL row by row.

    graph, texts = Graph(), Texts()
    node = graph.add(expression, leaf)          # None: only CEL can evaluate it
    program = Program(graph, [graph.truth(node)], texts)
    results = program.run(values, tags)         # a row for each of program.leaves

`values` defines columns, `nodes` the elements of a graph; `lowering` turns syntax into nodes, `program` groups them
into steps, and `operations` runs a step. If columns cannot decide a row, such as the order of two strings,
`Results.cel_rows` marks the row, and the caller evaluates the expression with CEL there.
"""

from wayside.expressions.columns.lowering import Constant, Graph
from wayside.expressions.columns.program import Program, Results
from wayside.expressions.columns.values import MISSING, NOWHERE, Column, Tag, Texts, column_of, value_at

__all__ = [
    "MISSING",
    "NOWHERE",
    "Column",
    "Constant",
    "Graph",
    "Program",
    "Results",
    "Tag",
    "Texts",
    "column_of",
    "value_at",
]
