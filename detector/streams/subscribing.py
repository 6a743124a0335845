"""How a stream is subscribed to: plainly, or by an Advanced Subscriber that requests missed samples from publishers.

A plain subscriber is faster, so streams without history and recovery use it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh
from zenoh import ext

from detector.streams.layouts import expression
from detector.streams.tally import Cause, Tally
from wayside.api.stream import Layout, Stream


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


def subscribe(session: zenoh.Session, stream: Stream, capacity: int, tally: Tally) -> Subscription:
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
            tally.add(Cause.MISSED, stream.name, count)

    return _Watched(subscriber, missed)
