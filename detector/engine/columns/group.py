"""Rules that are evaluated at the same ticks, in columns: from the samples in the tables to observations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.conditions import Codes, Conditions
from detector.engine.columns.signals import Signals
from detector.engine.columns.table import Truths
from detector.engine.columns.tables import Tables
from wayside.api.eventrule import Aggregate
from wayside.rules import ClientSubject, CompiledRule


def fits(rule: CompiledRule, tables: Tables) -> bool:
    """Whether a rule can be evaluated in columns."""
    budgeted = rule.maximum_per_hour is not None and len(rule.elements) > 1
    return isinstance(rule.subject, ClientSubject) and not budgeted and fit_signals(rule, tables)


def fit_signals(rule: CompiledRule, tables: Tables) -> bool:
    """Whether a rule's signals can be computed in columns."""
    streams = {stream.name: stream for stream in tables.streams}
    return (
        not rule.models
        and not rule.plugins
        and all(
            signal.rule is None
            and signal.aggregate is not Aggregate.ACTIVE
            and not (signal.aggregate is Aggregate.AGE and signal.where is not None)
            and tables.takes(streams[signal.stream])
            for signal in (*rule.signals, *(each for element in rule.elements for each in element.signals))
        )
    )


class Group:
    """The rules that are evaluated at the same ticks."""

    def __init__(self, tracks: Sequence[Track], context: Context) -> None:
        """All rules fit (see `fits`)."""
        self.tracks = tracks
        self._context = context
        self._signals = Signals(context, tracks)
        self._conditions = Conditions(context, tracks)
        if any("streams" in names_of(track.rule) for track in tracks):
            self._signals.watch_all_streams()

    def evaluate(
        self, ticks: Sequence[int], clients: Sequence[str], floor: int | None, looked: Truths | None = None
    ) -> tuple[Block, Codes]:
        """The rules' observations at the points: uint8, shape (tracks, clients, ticks).

        Windows do not reach back to `floor` or beyond. Counts what was unknown or failed at the points that a rule
        looks at: `looked`, shape (tracks, clients), or all.
        """
        block = Block(self._context, ticks, clients)
        block.present = self._present(block)
        block.looked = None if looked is None or looked.all() else looked
        self._signals.look(block, floor)
        for row, track in enumerate(self.tracks):
            points = block.points(row)
            track.counters.evaluations += len(clients) * len(ticks) if points is None else int(points.sum())
        return block, self._conditions.observed(block)

    def _present(self, block: Block) -> Truths | None:
        """Which clients are known at which ticks: within a block, some may come."""
        clients = self._context.clients
        if clients.newest <= block.ticks[0]:
            return None
        since = np.array([clients.since(client) for client in block.clients], np.int64)
        present: Truths = block.times[None, :] >= since[:, None]
        return present


def names_of(rule: CompiledRule) -> frozenset[str]:
    """The variables that a rule's conditions and the templates of its actions read."""
    expressions = [rule.when, rule.until, rule.subject.where if isinstance(rule.subject, ClientSubject) else None]
    templates = [
        *(deploy.parameters for deploy in rule.deploys),
        *(template for action in rule.actions for template in action.templates.values()),
    ]
    found = {name for each in expressions if each is not None for name in each.names}
    return frozenset(found.union(*(template.names for template in templates)))
