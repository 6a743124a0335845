"""The thread that sends: it asks its desk what to send now, sends it, and tells the desk what came of it.

The desk is everything that is to be decided; it does no I/O over the network and is only ever used under the courier's
lock. Sending takes as long as it takes, without the lock: whoever has something to tell never waits for it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from detector.actions.notify.outbox import Delivery, Fate

_log = logging.getLogger(__name__)

T = TypeVar("T")
"""What a desk gives to send."""

GRACE = 3.0
"""Seconds that remain for last attempts when the detector ends."""
_LONGEST_WAIT = 60.0


class Desk(Protocol[T]):
    """Decides what is sent, and when. `now` is in seconds of a monotonic clock."""

    def take(self, now: float) -> T | None:
        """What to send now."""

    def wait(self, now: float) -> float | None:
        """In how many seconds `take` may have something; None: not before something new comes."""

    def settle(self, sent: T, delivery: Delivery, now: float) -> None:
        """What came of it."""

    def hurry(self) -> None:
        """The end is near: all that waits is given once more."""


class Courier(Generic[T]):
    """Works from its start to `finish`. `send` is given what to send, and what says whether to give up on it."""

    def __init__(self, name: str, desk: Desk[T], send: Callable[[T, Callable[[], bool]], Delivery]) -> None:
        self._desk, self._send = desk, send
        self._changed = threading.Condition()
        self._deadline: float | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @contextmanager
    def at_desk(self) -> Iterator[None]:
        """Use the desk meanwhile; what waits there then is seen to."""
        with self._changed:
            yield
            self._changed.notify()

    def finish(self, grace: float = GRACE) -> None:
        """Try all once more, for at most so many seconds, and end; then the desk is the caller's."""
        with self._changed:
            self._deadline = time.monotonic() + grace
            self._desk.hurry()
            self._changed.notify()
        self._thread.join()

    def _over(self) -> bool:
        return self._deadline is not None and time.monotonic() >= self._deadline

    def _run(self) -> None:
        while (parcel := self._next()) is not None:
            try:
                delivery = self._send(parcel, self._over)
            except Exception as error:  # noqa: BLE001  a message that cannot be sent ends no thread
                _log.error("cannot send a notification", exc_info=error)
                delivery = Delivery(Fate.AGAIN, f"{type(error).__name__}: {error}")
            with self._changed:
                self._desk.settle(parcel, delivery, time.monotonic())

    def _next(self) -> T | None:
        """Waits for it; None: that was all."""
        with self._changed:
            while not self._over():
                now = time.monotonic()
                parcel = self._desk.take(now)
                if parcel is not None:
                    return parcel
                if self._deadline is not None:
                    return None
                wait = self._desk.wait(now)
                self._changed.wait(_LONGEST_WAIT if wait is None else min(wait, _LONGEST_WAIT))
            return None
