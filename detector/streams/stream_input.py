"""The samples of a stream across sessions: each sample once, and in order.

When one session replaces another, both are subscribed for a while. Samples of the old one are delivered at once, and
noted; samples of the new one are queued. Then the old one is undeclared, its remaining samples are delivered, and after
them the queued ones, except those that were noted. So no sample is lost or delivered twice, and per key no sample
overtakes another.

A sample is identified by the timestamp that routers (and peers) add to it. Without timestamps, samples with equal key
and content count as the same, within the second or so in which both sessions are subscribed.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from itertools import islice

import zenoh

from detector.streams.subscribing import Subscription

MAXIMUM_NOTED = 1_000_000
"""Maximum number of noted and of queued samples for one stream; beyond it, the sessions are exchanged at once."""

_LONGEST = 256
"""Maximum number of messages that are queued at once, so that they share the cost: receiving them takes a fraction of a
millisecond."""

_MAXIMUM_KEYS = 200_000

_COMPARED = 100
"""Number of samples of the new session that are compared with those of the old one: both sessions deliver in the same
order.
"""

_ECHO = 5.0
"""Seconds after the exchange in which the new session may still repeat samples of the old one."""


class StreamInput:
    """Samples of one stream. `bursts` is for its thread, everything else for the thread that exchanges sessions."""

    def __init__(self, subscription: Subscription, *, history: bool = False) -> None:
        """`history`: a new subscription repeats old samples; then the newest of each key is remembered."""
        self._subscription = subscription
        self._noted: Counter[Hashable] | None = None
        self._newest: dict[str, zenoh.Timestamp] | None = {} if history else None
        self._echo: Counter[Hashable] | None = None
        """Samples of the previous session, which the new one may repeat."""
        self._echo_ends = 0.0
        self._held: list[zenoh.Sample] = []
        self._second: Subscription | None = None
        self._changed = threading.Condition()
        self._expecting = False
        self._over = False

    def bursts(self) -> Iterator[list[zenoh.Sample]]:
        """The samples, without end. Raises ZError once the session is closed and no other replaces it."""
        while True:
            handler = self._subscription.handler
            receive, try_receive = handler.recv, handler.try_recv
            try:
                while True:
                    burst = [receive()]
                    burst.extend(islice(iter(try_receive, None), _LONGEST - 1))
                    # The hot path: without an exchange, it costs three attribute reads per burst.
                    if self._echo is None and self._noted is None and self._newest is None:
                        yield burst
                        continue
                    fresh = burst if self._echo is None else self._fresh(burst)
                    if (noted := self._noted) is not None:
                        noted.update(map(_identity, fresh))
                    if self._newest is not None:
                        self._remember(fresh)
                    if fresh:
                        yield fresh
            except zenoh.ZError:
                with self._changed:
                    self._changed.wait_for(lambda: self._second is not None or self._over or not self._expecting)
                    if self._second is None:
                        raise
                    self._subscription, self._second = self._second, None
                    self._expecting = False
                    held, self._held = self._held, []
            self._echo, self._noted = self._noted or Counter(), None
            self._echo_ends = time.monotonic() + _ECHO
            if first := self._fresh(held):
                yield first

    def note(self) -> None:
        """Start noting samples: another session is about to subscribe."""
        self._noted = Counter()

    def try_second(self, second: Subscription) -> None:
        """Queue the samples of the new session's subscription; call it often, so that Zenoh's queue does not fill."""
        if not self.full:
            self._held.extend(each for each in iter(second.handler.try_recv, None) if not self._is_old(each))

    @property
    def waits(self) -> bool:
        """Whether one session still has to deliver samples that the other has delivered."""
        noted = self._noted or Counter()
        if not noted and not self._held:
            return False
        return not any(_identity(sample) in noted for sample in islice(self._held, _COMPARED))

    @property
    def full(self) -> bool:
        """Whether the limit of noted or queued samples is reached."""
        return len(self._held) >= MAXIMUM_NOTED or len(self._noted or ()) >= MAXIMUM_NOTED

    @property
    def only_first(self) -> bool:
        """Whether samples arrive over the old session, but none over the new one."""
        return bool(self._noted) and not self._held

    def forget(self) -> None:
        """Cancel the exchange: this session stays."""
        self._noted = None
        self._held = []

    def expect(self) -> None:
        """The current session will be closed, and `follow` or `close` will be called."""
        with self._changed:
            self._expecting = True

    def follow(self, second: Subscription) -> None:
        """Switch to the new session once all samples of the old one are delivered."""
        with self._changed:
            self._second = second
            self._changed.notify_all()

    def withdraw(self) -> None:
        """Undeclare the old session's subscription; samples that it has received are still delivered."""
        self._subscription.undeclare()

    def close(self) -> None:
        """There will be no other session."""
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _fresh(self, samples: Sequence[zenoh.Sample]) -> list[zenoh.Sample]:
        """The samples without those of the previous session; the comparison ends once all of these were repeated."""
        echo = self._echo or Counter()
        fresh = []
        for sample in samples:
            identity = _identity(sample)
            if identity in echo:
                echo[identity] -= 1
                if not echo[identity]:
                    del echo[identity]
            elif not self._is_old(sample):
                fresh.append(sample)
        if time.monotonic() > self._echo_ends or (not echo and self._newest is None):
            self._echo = None
        return fresh

    def _is_old(self, sample: zenoh.Sample) -> bool:
        """Whether a history repeats an old sample."""
        newest = None if self._newest is None else self._newest.get(str(sample.key_expr))
        return newest is not None and sample.timestamp is not None and sample.timestamp <= newest

    def _remember(self, samples: Sequence[zenoh.Sample]) -> None:
        newest = self._newest
        if newest is None:
            return
        if len(newest) > _MAXIMUM_KEYS:
            newest.clear()
        newest.update((str(each.key_expr), each.timestamp) for each in samples if each.timestamp is not None)


def _identity(sample: zenoh.Sample) -> Hashable:
    stamp = sample.timestamp
    return (str(sample.key_expr), sample.payload.to_bytes() if stamp is None else str(stamp))
