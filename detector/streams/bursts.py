"""Messages are taken and handed over burst by burst: what a burst costs is shared by all that are in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice

import zenoh

Put = Callable[[Sequence[tuple[str, bytes]]], None]
"""Takes messages that came together: the key and the payload of each. Thread-safe, and never waits."""

_LONGEST = 256
"""At most so many messages get one receive time: taking that many takes a fraction of a millisecond."""


def bursts(samples: zenoh.handlers.Handler[zenoh.Sample]) -> Iterator[list[zenoh.Sample]]:
    """What waits in the channel, without end; raises ZError once the session is closed and none is left."""
    receive, try_receive = samples.recv, samples.try_recv
    while True:
        burst = [receive()]
        burst.extend(islice(iter(try_receive, None), _LONGEST - 1))
        yield burst
