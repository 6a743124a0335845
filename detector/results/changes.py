"""Changes in blocks of columns: the points at which a value differs from the previous one."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.results.series import Bytes, Doubles, Integers

_NEVER_SEEN = 255
"""Stands in for a tag: no tag has this value, so the first point always counts."""


class ChangePoints(NamedTuple):
    """Changes, in order of the clients, then of the times."""

    rows: NDArray[np.intp]
    """Indices of the block's clients."""
    ticks: NDArray[np.intp]
    """Indices of the block's ticks."""
    values: Doubles
    """The new values in stored form: texts may be recoded."""


class Changes:
    """The changes of one value for many clients, block after block."""

    def __init__(self) -> None:
        self._last_values: Integers = np.zeros(0, np.int64)
        self._last_tags: Bytes = np.zeros(0, np.uint8)
        self._parts: list[tuple[Integers, Integers, Doubles, Bytes]] = []

    def add(
        self, clients: Integers, times: Integers, values: Doubles, tags: Bytes, present: NDArray[np.bool_] | None
    ) -> ChangePoints:
        """Record the changes; returns their positions.

        Args:
            clients: numbers of the block's clients, the same in every block.
            times: the ticks, nanoseconds since the epoch, later than all before.
            values: shape (clients, ticks).
            tags: the same shape; values of different tags differ.
            present: the same shape: which points exist; None: all.
        """
        bits = np.ascontiguousarray(values).view(np.int64)
        self._make_room(int(clients.max()) + 1 if len(clients) else 0)
        changed = np.empty(bits.shape, bool)
        changed[:, 0] = (bits[:, 0] != self._last_values[clients]) | (tags[:, 0] != self._last_tags[clients])
        changed[:, 1:] = (bits[:, 1:] != bits[:, :-1]) | (tags[:, 1:] != tags[:, :-1])
        if present is not None:
            changed[:, 1:] |= ~present[:, :-1]
            changed &= present
            there = present[:, -1]
            clients_there = clients[there]
            self._last_values[clients_there] = bits[there, -1]
            self._last_tags[clients_there] = tags[there, -1]
        else:
            self._last_values[clients] = bits[:, -1]
            self._last_tags[clients] = tags[:, -1]
        rows, ticks = np.nonzero(changed)
        new = values[rows, ticks]
        if len(rows):
            self._parts.append((clients[rows], times[ticks], new, tags[rows, ticks]))
        return ChangePoints(rows, ticks, new)

    def by_client(self, chosen: Container[int] | None) -> Iterator[tuple[int, Integers, Doubles, Bytes]]:
        """For each chosen client (None: all), its number, and the times, values and tags of its changes."""
        if not self._parts:
            return
        clients, times, values, tags = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        order = np.argsort(clients, kind="stable")
        clients, times, values, tags = clients[order], times[order], values[order], tags[order]
        bounds = [0, *(np.flatnonzero(np.diff(clients)) + 1).tolist(), len(clients)]
        for client, begin, end in zip(clients[bounds[:-1]].tolist(), bounds, bounds[1:], strict=False):
            if chosen is None or client in chosen:
                yield client, times[begin:end], values[begin:end], tags[begin:end]

    def _make_room(self, room: int) -> None:
        more = room - len(self._last_tags)
        if more > 0:
            self._last_values = np.append(self._last_values, np.zeros(more, np.int64))
            self._last_tags = np.append(self._last_tags, np.full(more, _NEVER_SEEN, np.uint8))
