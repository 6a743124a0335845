"""Signals over the episodes of other rules, in columns. Episodes are few: only clients with episodes are evaluated."""

from __future__ import annotations

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN, Reason
from wayside.expressions.columns.values import Column, Tag, column_of
from wayside.rules import CompiledSignal


def of_episodes(context: Context, block: Block, track: Track, signal: CompiledSignal) -> Column:
    """The signal at each point. Counts unknown values and failures."""
    counters, ticks = track.counters, block.ticks
    evaluated = block.points(track.row)
    points = np.ones(block.shape, bool) if evaluated is None else evaluated.reshape(block.shape)
    values, tags = np.zeros(block.shape), np.zeros(block.shape, np.uint8)
    column = Column(values.reshape(-1), tags.reshape(-1))
    if not context.starts.is_evaluated(signal.stream):
        if points.any():
            message = f"signal {signal.name}: rule {signal.rule} is disabled, refused or gone"
            counters.note(Reason.ABSENT, message, times=int(points.sum()))
        return column
    if signal.aggregate is Aggregate.ACTIVE:
        tags[:] = Tag.BOOLEAN
        for at, client in enumerate(block.clients):
            for begin, end in context.starts.spans(client, signal.stream):
                values[at, (block.times >= begin) & (block.times < end)] = 1.0
        return column
    some = [at for at, client in enumerate(block.clients) if context.starts.lane(client, signal.stream) is not None]
    none = np.ones(len(block.clients), bool)
    none[some] = False
    match signal.aggregate:
        case Aggregate.AGE:
            since = np.array([context.clients.since(client) for client in block.clients], np.int64)
            values[none], tags[none] = (block.times - since[none, None]) / 1e9, Tag.NUMBER
        case Aggregate.COUNT:
            tags[none] = Tag.NUMBER
        case Aggregate.ANY:
            tags[none] = Tag.BOOLEAN
        case _:
            counters.unknowns += int(points[none].sum())
    for at in some:
        found = [
            context.of_starts.value(track.rule.name, signal, block.clients[at], tick, counters) if there else UNKNOWN
            for tick, there in zip(ticks, points[at].tolist(), strict=True)
        ]
        own = column_of(found, context.tables.texts)
        values[at], tags[at] = own.values, Tag.NUMBER if own.tags is None else own.tags
        if own.others is not None:
            if column.others is None:
                column.others = np.full(values.size, None, dtype=object)
            column.others.reshape(block.shape)[at] = own.others
    return column
