"""How a stream is subscribed to, and its samples are delivered.

By a plain subscriber, or by an Advanced Subscriber that requests missed samples from publishers: a plain one is faster,
so streams without history and recovery use it. Each layout of keys has a separate pump, so that its work per sample
costs the others nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import compress
from operator import itemgetter
from typing import Protocol

import zenoh
from zenoh import ext

from detector.engine.samples.intake import Put
from detector.streams import rmw_zenoh
from detector.streams.loss_counter import Cause, LossCounter
from wayside.api.stream import Layout, Stream
from wayside.keys import KeyPattern

_PAYLOAD = itemgetter(1)


def pump_by_key(bursts: Iterable[Sequence[zenoh.Sample]], put: Put) -> None:
    """Delivers every message by its key, burst by burst; raises the errors of receiving a burst."""
    put_kind = zenoh.SampleKind.PUT
    for burst in bursts:
        messages = [(str(sample.key_expr), sample.payload.to_bytes()) for sample in burst]
        if not all(map(_PAYLOAD, messages)):  # a deletion is no message; checking the kind of each would cost more
            messages = list(compress(messages, [sample.kind == put_kind for sample in burst]))
        put(messages)


Pump = Callable[[Iterable[Sequence[zenoh.Sample]]], None]
"""Delivers all samples, burst by burst; raises the errors of receiving a burst."""


def expression(stream: Stream) -> zenoh.KeyExpr:
    """The key expression to subscribe to. Raises KeyPatternError."""
    topics = KeyPattern.parse(stream.key).expression
    match stream.layout:
        case Layout.PLAIN:
            return zenoh.KeyExpr.autocanonize(topics)
        case Layout.RMW_ZENOH:
            return zenoh.KeyExpr.autocanonize(rmw_zenoh.topics_expression(topics, stream.domain))


def pump_for(stream: Stream, put: Put, loss_counter: LossCounter) -> Pump:
    """The function that delivers the stream's samples; problems on the way are counted in `loss_counter`."""
    match stream.layout:
        case Layout.PLAIN:
            return partial(pump_by_key, put=put)
        case Layout.RMW_ZENOH:
            return partial(
                rmw_zenoh.pump_by_topic, put=put, reader=rmw_zenoh.RmwReader(stream.name, stream.type, loss_counter)
            )


class Subscription(Protocol):
    """A subscriber of either kind; undeclared when nothing refers to it any more."""

    @property
    def handler(self) -> zenoh.handlers.Handler[zenoh.Sample]:
        """The channel in which samples are queued."""

    def undeclare(self) -> None:
        """Undeclare it; samples in the channel can still be taken."""


class _Watched:
    """An Advanced Subscriber and its listener for misses, which have the same lifetime."""

    def __init__(
        self, subscriber: ext.AdvancedSubscriber[zenoh.handlers.Handler[zenoh.Sample]], missed: Callable[[int], None]
    ) -> None:
        self._subscriber = subscriber
        self._listener = subscriber.sample_miss_listener(lambda miss: missed(miss.nb))

    @property
    def handler(self) -> zenoh.handlers.Handler[zenoh.Sample]:
        return self._subscriber.handler

    def undeclare(self) -> None:
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]


def subscribe(session: zenoh.Session, stream: Stream, capacity: int, loss_counter: LossCounter) -> Subscription:
    """Subscribes to the stream's key; at most `capacity` samples are queued. Raises KeyPatternError, zenoh.ZError."""
    channel: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(capacity)
    if stream.history is None and not stream.recover:
        return session.declare_subscriber(expression(stream), channel)
    history = stream.history
    subscriber = ext.declare_advanced_subscriber(
        session,
        expression(stream),
        channel,
        history=None
        if history is None
        else ext.HistoryConfig(
            detect_late_publishers=True,
            max_samples=history.samples,
            max_age=None if history.age is None else history.age.seconds,
        ),
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if stream.recover else None,
    )

    def missed(count: int) -> None:
        if stream.layout is Layout.PLAIN:  # rmw_zenoh numbers its samples itself: losses are counted once
            loss_counter.add(Cause.MISSED, stream.name, count)

    return _Watched(subscriber, missed)
