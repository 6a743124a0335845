"""Finds the rows that columns cannot decide, so that the caller evaluates them with CEL."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from wayside.expressions.columns.frame import Array, Frame
from wayside.expressions.columns.nodes import CelCheck, Nodes, NodeType, Op, RowsForCel
from wayside.expressions.columns.values import Bools, Bytes, Tag

Places = Mapping[int, tuple[Array, int]]
CelRows = Mapping[int, Bools]
"""bool[n] by the number of a check: the rows that the check found, if any."""


class CelChecks:
    """The checks below each root of a program. Nearly always, no check finds a row, and the cost is negligible."""

    def __init__(self, graph: Nodes, roots: Sequence[int], places: Places) -> None:
        self._places = places
        numbers: dict[CelCheck, int] = {}
        self._below = {
            root: frozenset(numbers.setdefault(check, len(numbers)) for check in _checks(graph, root)) for root in roots
        }
        self._of_others: dict[int, int] = {}
        """The checks for the tag OTHER, by the row of the leaf."""
        self._of_texts: dict[tuple[int, int], int] = {}
        """The checks for strings in two leaves, by the rows of the leaves."""
        self._rest: list[tuple[int, CelCheck]] = []
        for check, number in numbers.items():
            rows = [places[node][1] for node in check.nodes]
            if check.rows is RowsForCel.UNEXPECTED or any(places[n][0] is not Array.LEAVES for n in check.nodes):
                self._rest.append((number, check))
            elif check.rows is RowsForCel.OTHER:
                self._of_others[rows[0]] = number
            else:
                self._of_texts[rows[0], rows[1]] = number

    def find(self, frame: Frame) -> CelRows:
        """The rows that all checks find in one run."""
        return dict(self._find(frame))

    def _find(self, frame: Frame) -> Iterator[tuple[int, Bools]]:
        if frame.odd:
            for row in frame.leaves_with(Tag.OTHER) & self._of_others.keys():
                yield self._of_others[row], _holds(frame.leaf_tags[row], Tag.OTHER)
            texts = frame.leaves_with(Tag.TEXT) if self._of_texts else frozenset()
            for (one, other), number in self._of_texts.items() if texts else ():
                if one in texts and other in texts:
                    yield number, _holds(frame.leaf_tags[one], Tag.TEXT) & _holds(frame.leaf_tags[other], Tag.TEXT)
        for number, check in self._rest:
            found = self._found(check, frame)
            if found is not None and found.any():
                yield number, found

    def rows(self, root: int, found: CelRows) -> Bools | None:
        """bool[n]: the rows that the checks below the root found; None for no row. Raises KeyError for other nodes."""
        checks = self._below[root]
        rows: Bools | None = None
        for number, here in found.items():
            if number in checks:
                rows = here if rows is None else rows | here
        return rows if rows is not None and rows.any() else None

    def _found(self, check: CelCheck, frame: Frame) -> Bools | None:
        tags = [self._tags(each, frame) for each in check.nodes]
        first = tags[0]
        if check.rows is RowsForCel.UNEXPECTED:
            if check.expected is Tag.NUMBER and not frame.odd:
                return None
            if first is None:
                return np.ones(frame.leaves.shape[1], bool)
            return ~(_holds(first, check.expected) | _holds(first, Tag.ABSENT) | _holds(first, Tag.UNREACHABLE))
        wanted = Tag.OTHER if check.rows is RowsForCel.OTHER else Tag.TEXT
        rows = [None if each is None else _holds(each, wanted) for each in tags]
        if len(rows) == 1:
            return rows[0]
        return None if rows[0] is None or rows[1] is None else rows[0] & rows[1]

    def _tags(self, node: int, frame: Frame) -> Bytes | None:
        """The tags of a node; None: all rows are numbers."""
        source, row = self._places[node]
        if source is Array.LEAVES and not frame.tagged:
            return None
        tags: Bytes = (frame.leaf_tags if source is Array.LEAVES else frame.mixed_tags)[row]
        return tags


def _holds(tags: Bytes, tag: Tag) -> Bools:
    found: Bools = tags == np.uint8(tag)
    return found


def _checks(graph: Nodes, root: int) -> tuple[CelCheck, ...]:
    found: dict[CelCheck, None] = {}
    if graph.nodes[root].holds is NodeType.ANY and graph.nodes[root].op is Op.CHOOSE:
        found[CelCheck(RowsForCel.OTHER, (root,))] = None
    seen, pending = {root}, [root]
    while pending:
        number = pending.pop()
        found.update(dict.fromkeys(graph.checks(number)))
        for each in graph.nodes[number].operands:
            if each not in seen:
                seen.add(each)
                pending.append(each)
    return tuple(found)
