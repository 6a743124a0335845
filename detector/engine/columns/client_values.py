"""The values of clients that expressions read, as columns: signals, labels, parameters and names."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.reading import constant
from wayside.expressions import Path
from wayside.expressions.columns.lowering import Constant
from wayside.expressions.columns.values import MISSING, Column, Tag, column_of


class ClientValues:
    """The leaves of programs over the clients of a block."""

    def __init__(self, context: Context, tracks: Sequence[Track]) -> None:
        """The tracks know the indices of their signals."""
        self._context = context
        self._rules = {track.rule.name: track.rule for track in tracks}

    def leaf(self, track: Track, path: Path) -> Hashable | Constant | None:
        """The leaf of a path in an expression about one client; None: no column represents it."""
        if str(path[0]) in track.element.variables:
            return constant(track.element.variables, path)
        return self.of_client(track, path)

    def of_client(self, track: Track, path: Path) -> Hashable | Constant | None:
        """The leaf of a path that starts at a variable of the client; None: no column represents it."""
        name = str(path[0])
        if name in track.signals:
            return ("signal", track.signals[name]) if len(path) == 1 else None
        if name == "client":
            return ("client",) if len(path) == 1 else None
        if name == "parameters" and len(path) > 1:
            parameters = track.rule.parameters
            if not parameters.overridden:
                return constant({"parameters": parameters.own}, path)
            return ("parameters", track.rule.name, *path[1:])
        if name == "labels":
            return path if len(path) == 2 else None
        return None

    def column(self, block: Block, leaf: Any) -> Column:
        """The value of a leaf for each client; of signals: at each point."""
        if leaf[0] == "signal":
            column: Column = block.signals[leaf[1]]
            return column
        texts = self._context.tables.texts
        if leaf[0] == "client":
            codes = np.array([texts.code(client) for client in block.clients], float)
            return Column(codes, np.full(len(codes), Tag.TEXT, np.uint8), None)
        return column_of([*self._values(block, leaf)], texts)

    def at_points(self, block: Block, leaf: Any) -> Column:
        """The value of a leaf at each point of a block."""
        column = self.column(block, leaf)
        if leaf[0] == "signal":
            return column
        times = len(block.ticks)
        return Column(
            np.repeat(column.values, times),
            None if column.tags is None else np.repeat(column.tags, times),
            None if column.others is None else np.repeat(column.others, times),
        )

    def _values(self, block: Block, leaf: tuple[Any, ...]) -> Iterator[Any]:
        """A label or a parameter of each client."""
        for client in block.clients:
            if leaf[0] == "labels":
                yield self._context.clients.labels(client).get(leaf[1], MISSING)
                continue
            value: Any = self._rules[leaf[1]].parameters.of(client)
            for step in leaf[2:]:
                value = value.get(step, MISSING) if isinstance(value, Mapping) else MISSING
            yield value
