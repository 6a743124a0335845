"""How often an Event may be posted about one object: a few times at once, then only now and then. Pure."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

BURST = 10
"""Events of one object that may follow each other at once."""

REFILL = 60.0
"""Seconds after which one more may follow: an object that changes all the time has an Event a minute."""

_KEPT = 10_000  # objects that are remembered; the one with the oldest Event is forgotten, and starts over


class Allowance:
    """Tokens for each object: `BURST` at first, one more each `REFILL` seconds."""

    def __init__(self) -> None:
        self._left: OrderedDict[Hashable, tuple[float, float]] = OrderedDict()  # tokens, as of when

    def takes(self, key: Hashable, now: float) -> bool:
        """Whether one more may be posted about the object at `now`, in seconds; if so, it is counted."""
        tokens, since = self._left.pop(key, (float(BURST), now))
        tokens = min(float(BURST), tokens + max(0.0, now - since) / REFILL)
        allowed = tokens >= 1
        self._left[key] = (tokens - 1 if allowed else tokens, now)
        if len(self._left) > _KEPT:
            self._left.popitem(last=False)
        return allowed
