"""Rules that are evaluated at the same ticks, in columns: from the samples in the tables to observations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from detector.engine.buffering.clients import Clients
from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.conditions import Conditions
from detector.engine.columns.derived import ClientDerived
from detector.engine.columns.signals import SignalColumns
from detector.engine.columns.table import Truths
from detector.engine.columns.tables import Tables
from detector.engine.columns.verdicts import Codes, Ternary, observed
from detector.engine.episodes.episodes import FALSE
from detector.engine.episodes.subjects import Subject
from wayside.api.eventrule import Aggregate
from wayside.expressions import Expression
from wayside.rules import ClientSubject, CompiledRule, CompiledSignal


def fits_clients(rule: CompiledRule) -> bool:
    """Whether a rule about clients can be evaluated in columns; its signals are known to fit."""
    budgeted = rule.maximum_per_hour is not None and len(rule.elements) > 1
    return isinstance(rule.subject, ClientSubject) and not budgeted


def fit_signals(rule: CompiledRule, tables: Tables) -> bool:
    """Whether a rule's signals can be computed in columns."""
    streams = {stream.name: stream for stream in tables.streams}
    return (
        not rule.models
        and not rule.plugins
        and all(
            signal.rule is not None
            or (
                not (signal.aggregate is Aggregate.AGE and signal.where is not None)
                and tables.supports(streams[signal.stream])
            )
            for signal in signals_of(rule)
        )
    )


def signals_of(rule: CompiledRule) -> Iterator[CompiledSignal]:
    """All of a rule's signals, including those of its elements."""
    yield from rule.signals
    for element in rule.elements:
        yield from element.signals


class ClientGroup:
    """The rules about clients that are evaluated at the same ticks."""

    needs_clients = True

    def __init__(self, tracks: Sequence[Track], context: Context) -> None:
        """All rules fit (see `fits_clients`)."""
        self.tracks = tracks
        self._context = context
        self._signals = SignalColumns(context, tracks)
        derived = [track for track in tracks if track.rule.derived]
        self._derived = ClientDerived(context, derived, self._signals.count) if derived else None
        self._conditions = Conditions(context, tracks, _conditions)
        if any("streams" in names_of(track.rule) for track in tracks):
            self._signals.watch_all_streams()

    def evaluate(
        self, ticks: Sequence[int], clients: Sequence[str], floor: int | None, selected: Truths | None = None
    ) -> tuple[Block, Codes]:
        """The rules' observations at the points: uint8, shape (tracks, clients, ticks).

        Windows start after `floor`. Counts unknown values and failures at the points that a rule evaluates: those of
        the `selected` clients, shape (tracks, clients), or all.
        """
        block = Block(self._context, ticks, clients)
        block.present = present(block, self._context.clients)
        block.selected = None if selected is None or selected.all() else selected
        self._signals.compute(block, floor)
        if self._derived is not None:
            self._derived.compute(block)
        count = len(clients) * len(ticks)
        whole = block.present is None and block.selected is None
        for row, track in enumerate(self.tracks):
            track.counters.evaluations += count if whole else block.evaluated(row)
        return block, self._observed(block)

    def _observed(self, block: Block) -> Codes:
        found = self._conditions.verdicts(block)
        when = found["when"]
        until, scope = Ternary(when.false, when.true), None
        if "until" in found:
            until = self._where_any("until", found["until"], until)
        if "where" in found:
            scope = self._where_any("where", found["where"], Ternary(np.array(True), np.array(False)))
        codes = observed(when, until, scope).reshape(len(self.tracks), *block.shape)
        if block.present is not None:
            codes[:, ~block.present] = FALSE
        return codes

    def _where_any(self, field: str, verdict: Ternary, otherwise: Ternary) -> Ternary:
        """A condition's verdict; `otherwise` for the rules without the condition."""
        has = self._conditions.has(field)
        return Ternary(np.where(has, verdict.true, otherwise.true), np.where(has, verdict.false, otherwise.false))

    @property
    def room(self) -> int:
        """An upper bound of the numbers of a rule's subjects."""
        return len(self._context.tables.names)

    def number(self, subject: Subject) -> int:
        """The number of a subject among the subjects of its rule and element."""
        return self._context.tables.number(subject.clients[0])


def _conditions(rule: CompiledRule) -> Mapping[str, Expression]:
    where = rule.subject.where if isinstance(rule.subject, ClientSubject) else None
    conditions = {"where": where, "when": rule.when, "until": rule.until}
    return {field: each for field, each in conditions.items() if each is not None}


def present(block: Block, clients: Clients) -> Truths | None:
    """Which clients are known at which ticks: some may appear within a block. None: all clients at all ticks."""
    if clients.newest <= block.ticks[0]:
        return None
    since = np.array([clients.since(client) for client in block.clients], np.int64)
    known: Truths = block.times[None, :] >= since[:, None]
    return known


def names_of(rule: CompiledRule) -> frozenset[str]:
    """The variables that a rule's conditions, signals over others and the templates of its actions read."""
    templates = [
        *(deploy.parameters for deploy in rule.deploys),
        *(template for action in rule.actions for template in action.templates.values()),
    ]
    conditions = [*_conditions(rule).values(), *(each.of for each in rule.derived if each.of is not None)]
    found = {name for each in conditions for name in each.names}
    return frozenset(found.union(*(template.names for template in templates)))
