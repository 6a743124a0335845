"""The samples of a stream, over one session after another, each once and in order.

When one session takes the place of another, both are subscribed for a while. What comes over the old one goes on at
once, and is noted; what comes over the new one waits. Then the old one is withdrawn, what it had received is taken, and
after that what waited, without what was noted. So nothing is lost, nothing is taken twice, and on no key does a sample
overtake another.

A sample is known again by the timestamp that routers (and peers) give to each. Without timestamps, those that are equal
in key and content count as the same, within the second or so in which both sessions are subscribed.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from itertools import islice

import zenoh

from detector.streams.bursts import LONGEST
from detector.streams.subscribing import Subscription

MAXIMUM_NOTED = 1_000_000
"""Maximum samples noted, and maximum samples waiting, for one stream; beyond, the sessions are exchanged at once."""

_MAXIMUM_KEYS = 200_000

_LOOKED_AT = 100
"""Number of samples of the new session that are searched among those of the old one: the first ones come there first
too.
"""

_ECHO = 5.0
"""Seconds after the exchange in which the new session may still deliver what the old one had: then all has come."""


class Inlet:
    """Samples of one stream. `bursts` is for its thread, everything else for the one who exchanges sessions."""

    def __init__(self, subscription: Subscription, *, history: bool = False) -> None:
        """`history`: a new subscription gives old samples again; then the newest of each key is remembered."""
        self._subscription = subscription
        self._noted: Counter[Hashable] | None = None
        self._newest: dict[str, zenoh.Timestamp] | None = {} if history else None
        self._echo: Counter[Hashable] | None = None
        """What came over the session before, and may come once more."""
        self._echo_ends = 0.0
        self._held: list[zenoh.Sample] = []
        self._second: Subscription | None = None
        self._changed = threading.Condition()
        self._expecting = False
        self._over = False

    def bursts(self) -> Iterator[list[zenoh.Sample]]:
        """What comes, without end. Raises ZError once the session is closed and no other takes its place."""
        while True:
            handler = self._subscription.handler
            receive, try_receive = handler.recv, handler.try_recv
            try:
                while True:
                    burst = [receive()]
                    burst.extend(islice(iter(try_receive, None), LONGEST - 1))
                    # The hot path: where no sessions are exchanged, it costs three looks at attributes a burst.
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
        """Take the samples of the new session's subscription; call it often, so that its queue does not fill."""
        if not self.full:
            self._held.extend(each for each in iter(second.handler.try_recv, None) if not self._is_old(each))

    @property
    def waits(self) -> bool:
        """Whether the old session still has to deliver what the new one has, or the other way round."""
        noted = self._noted or Counter()
        if not noted and not self._held:
            return False
        return not any(_identity(sample) in noted for sample in islice(self._held, _LOOKED_AT))

    @property
    def full(self) -> bool:
        """Whether no more should wait, or be noted."""
        return len(self._held) >= MAXIMUM_NOTED or len(self._noted or ()) >= MAXIMUM_NOTED

    @property
    def only_first(self) -> bool:
        """Whether samples come over the old session, and none over the new one."""
        return bool(self._noted) and not self._held

    def forget(self) -> None:
        """Cancel the exchange: this session stays."""
        self._noted = None
        self._held = []

    def expect(self) -> None:
        """The session that is used now will be withdrawn, and `follow` or `close` be called."""
        with self._changed:
            self._expecting = True

    def follow(self, second: Subscription) -> None:
        """Go on with the new session once all that the old one received is taken."""
        with self._changed:
            self._second = second
            self._changed.notify_all()

    def withdraw(self) -> None:
        """Nothing more is wanted of the old session; what it has received is still taken."""
        self._subscription.undeclare()

    def close(self) -> None:
        """There will be no other session."""
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _fresh(self, samples: Sequence[zenoh.Sample]) -> list[zenoh.Sample]:
        """Without what came over the session before; once that has come again, nothing is looked for."""
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
        """Whether a history gives again what came long ago."""
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
