"""A block: some ticks and some clients, and the values that rules read at each point of them.

A point is a tick and a client. In all arrays of a block, clients are the first axis and ticks change fastest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from detector.engine.buffering.clients import Clients
from detector.engine.buffering.naming import PossibleStreams
from detector.engine.columns.earlier import EarlierValues
from detector.engine.columns.table import Integers, Truths
from detector.engine.columns.tables import Tables
from detector.engine.columns.verdicts import Ternary
from detector.engine.counters import RuleCounters
from detector.engine.episodes.subjects import FLEET, Subject
from detector.engine.scoping.positions import PositionLookup
from detector.engine.signals.signals import Signals as OfStarts
from detector.engine.signals.starts import EpisodeStarts
from wayside.expressions import UNKNOWN
from wayside.expressions.columns.values import Column, value_at
from wayside.rules import CompiledElement, CompiledRule

_MAXIMUM_SUBJECTS = 100_000
"""Maximum number of cached subjects of a rule."""


class Context(NamedTuple):
    """The inputs of rules."""

    tables: Tables
    clients: Clients
    stale_after: Mapping[str, int | None]
    possible: PossibleStreams
    positions: PositionLookup
    starts: EpisodeStarts
    of_starts: OfStarts
    """Computes signals over other rules' episodes."""
    exact: bool
    """See `steps.ORDER`; False is order 1."""


class Track:
    """A rule, for one element of its `each`."""

    def __init__(
        self,
        rule: CompiledRule,
        element: CompiledElement,
        counters: RuleCounters,
        place: Mapping[str, str],
        row: int,
        earlier: EarlierValues,
    ) -> None:
        """`place`: by condition, the text about its inputs that errors contain. `row`: the track's index in its group.

        `earlier` has the earlier values of the rule's signals over other signals.
        """
        self.rule = rule
        self.element = element
        self.counters = counters
        self.place = place
        self.row = row
        self.earlier = earlier
        self.signals: dict[str, int] = {}
        """Indices of the rule's signals in the group, by name, in the order of the rule."""
        self._subjects: dict[str, Subject] = {}

    def subject(self, client: str) -> Subject:
        """The subject of the client, or of the fleet."""
        subject = self._subjects.get(client)
        if subject is None:
            if len(self._subjects) > _MAXIMUM_SUBJECTS:
                self._subjects.clear()
            subject = self._subjects[client] = Subject(() if client == FLEET else (client,), self.element.name)
        return subject


class Block:
    """The values that the rules of a group read at some ticks, for some clients."""

    def __init__(
        self, context: Context, ticks: Sequence[int], clients: Sequence[str], numbers: Integers | None = None
    ) -> None:
        """`numbers`: the numbers of the clients in the tables; None: look them up."""
        self.ticks = ticks
        self.times: Integers = np.array(ticks, np.int64)
        self.clients = clients
        if numbers is None:
            numbers = np.array([context.tables.number(client) for client in clients], np.int64)
        self.numbers: Integers = numbers
        self.signals: list[Column] = []
        self.fresh: dict[str, Truths] = {}
        """By stream, whether the stream is fresh at each point; shape (clients, ticks)."""
        self.stale: set[str] = set()
        """The streams that are not fresh at some point."""
        self.latest: dict[str, Integers] = {}
        """By stream: the time of the newest sample, or NEVER."""
        self.present: Truths | None = None
        """Which points exist; None: all. Shape (clients, ticks)."""
        self.selected: Truths | None = None
        """Which clients each rule evaluates; None: all. Shape (tracks, clients)."""
        self.measured: dict[tuple[int, str], Column] = {}
        """By track and signal over the open episode, the values that the signal aggregates."""
        self.verdicts: Mapping[str, Ternary] = {}
        """By field, where conditions are true and where false; shape (tracks, points)."""
        self._context = context

    @property
    def shape(self) -> tuple[int, int]:
        """Number of clients and of ticks."""
        return len(self.clients), len(self.ticks)

    def points(self, row: int) -> Truths | None:
        """The points that a track evaluates, flat; None: all."""
        if self.selected is None:
            return None if self.present is None else self.present.ravel()
        selected = np.repeat(self.selected[row], len(self.ticks))
        return selected if self.present is None else selected & self.present.ravel()

    def evaluated(self, row: int) -> int:
        """Number of points that a track evaluates."""
        own = self.points(row)
        return len(self.clients) * len(self.ticks) if own is None else int(own.sum())

    def count(self, row: int, points: Truths) -> int:
        """Number of these points that a track evaluates."""
        own = self.points(row)
        return int(points.sum()) if own is None else int((points & own).sum())

    def variables(self, track: Track, point: int) -> dict[str, Any]:
        """The variables of expressions at a point, as in `scopes`."""
        view = self.view(track, point)
        view.update(track.element.variables)
        return view

    def view(self, track: Track, point: int) -> dict[str, Any]:
        """The variables of expressions at a point, without those of the element."""
        client = self.clients[point // len(self.ticks)]
        return {
            "client": client,
            "labels": self._context.clients.labels(client),
            "streams": [stream for stream, fresh in self.fresh.items() if fresh.item(point)],
            "parameters": track.rule.parameters.of(client),
            **self.values(track, point),
        }

    def values(self, track: Track, point: int) -> dict[str, Any]:
        """The known values of the rule's signals at a point."""
        found: dict[str, Any] = {}
        for name, at in track.signals.items():
            if at >= len(self.signals):  # signals over others that are being computed now
                continue
            column = self.signals[at]
            if column.tags is None:
                found[name] = column.values.item(point)
            elif (value := value_at(column, point, self._context.tables.texts)) is not UNKNOWN:
                found[name] = value
        return found

    def measured_at(self, row: int, point: int) -> dict[str, Any]:
        """The known values at a point that a track's signals over the open episode aggregate."""
        texts = self._context.tables.texts
        found = {name: value_at(column, point, texts) for (of, name), column in self.measured.items() if of == row}
        return {name: value for name, value in found.items() if value is not UNKNOWN}

    def last(self, points: Integers) -> int:
        """The latest of some points: by tick, then by client."""
        ticks = points % len(self.ticks)
        return int(points[np.flatnonzero(ticks == ticks.max())[-1]])
