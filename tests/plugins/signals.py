"""Plugins for tests, registered as if a package had brought them: put `tests/plugins/package` on sys.path."""

from __future__ import annotations

import os
import time

from detector.plugins import Plugin, PluginParameters, Queries, StreamName
from wayside.expressions import Value


class CountingParameters(PluginParameters):
    """Which stream, and when to go wrong."""

    stream: StreamName
    limit: float = 3.0
    raise_at: float | None = None
    hang_at: float | None = None
    exit_at: float | None = None


class Counting(Plugin[CountingParameters]):
    """Counts the evaluations of a subject; fails if the newest value of the stream requests it."""

    Parameters = CountingParameters
    count = 0

    def value(self, queries: Queries, clients: tuple[str, ...]) -> Value:
        self.count += 1
        newest = queries.newest(clients[0] if clients else None, self.parameters.stream)
        if newest is None:
            return None
        reported = newest.message["v"]
        if reported == self.parameters.raise_at:
            raise ValueError(f"{reported:g} is not acceptable")
        while reported == self.parameters.hang_at:
            time.sleep(0.01)
        if reported == self.parameters.exit_at:
            os._exit(3)
        return {"count": self.count, "clients": list(clients), "v": reported}


class InvalidValue(Plugin[CountingParameters]):
    """Its value is no plain data."""

    Parameters = CountingParameters

    def value(self, queries: Queries, clients: tuple[str, ...]) -> Value:
        return {1, 2}  # type: ignore[return-value]
