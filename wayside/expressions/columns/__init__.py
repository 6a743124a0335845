"""CEL expressions over columns: many rules and many rows at once, with the results that CEL gives row by row.

    graph, texts = Graph(), Texts()
    node = graph.add(expression, leaf)          # None: only CEL can evaluate it
    program = Program(graph, [graph.truth(node)], texts)
    results = program.run(values, tags)         # a row for each of program.leaves

`values` defines columns, `nodes` the elements of a graph, `lowering` turns syntax into nodes, `program` puts
them into steps, and `operations` runs a step. Where a row holds what columns cannot decide, such as two texts that are
ordered, `Results.foreign` marks the row, and the caller evaluates the expression itself there.
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
