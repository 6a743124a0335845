"""The thread that sends: it takes the next item from its queue, sends it, and reports the result to the queue.

The queue makes all decisions; it does no network I/O and is only used under the lock of the sender. The lock is not
held during sending, so a producer never waits for it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from detector.actions.notify.outbox import AttemptResult, Delivery

_log = logging.getLogger(__name__)

T = TypeVar("T")
"""An item of a queue."""

GRACE = 3.0
"""Seconds for last attempts when the detector ends."""
_LONGEST_WAIT = 60.0


class SendQueue(Protocol[T]):
    """Decides what is sent and when. `now` is in seconds of a monotonic clock."""

    def take(self, now: float) -> T | None:
        """The item to send now."""

    def wait(self, now: float) -> float | None:
        """Seconds until `take` may return something; None: not before something new is added."""

    def settle(self, sent: T, delivery: Delivery, now: float) -> None:
        """Apply the result."""

    def hurry(self) -> None:
        """The end is near: return each queued item once more."""


class Sender(Generic[T]):
    """Runs from its start to `finish`. `send` receives the item, and a function that returns whether to give up."""

    def __init__(self, name: str, queue: SendQueue[T], send: Callable[[T, Callable[[], bool]], Delivery]) -> None:
        self._queue, self._send = queue, send
        self._changed = threading.Condition()
        self._deadline: float | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Hold the lock to change the queue, then wake the thread."""
        with self._changed:
            yield
            self._changed.notify()

    def finish(self, grace: float = GRACE) -> None:
        """Try everything once more, for at most `grace` seconds, and end; afterwards the caller owns the queue."""
        with self._changed:
            self._deadline = time.monotonic() + grace
            self._queue.hurry()
            self._changed.notify()
        self._thread.join()

    def _over(self) -> bool:
        return self._deadline is not None and time.monotonic() >= self._deadline

    def _run(self) -> None:
        while (parcel := self._next()) is not None:
            try:
                delivery = self._send(parcel, self._over)
            except Exception as error:  # noqa: BLE001  a message that cannot be sent must not end the thread
                _log.error("cannot send a notification", exc_info=error)
                delivery = Delivery(AttemptResult.AGAIN, f"{type(error).__name__}: {error}")
            with self._changed:
                self._queue.settle(parcel, delivery, time.monotonic())

    def _next(self) -> T | None:
        """The next item, after waiting for it; None at the end."""
        with self._changed:
            while not self._over():
                now = time.monotonic()
                parcel = self._queue.take(now)
                if parcel is not None:
                    return parcel
                if self._deadline is not None:
                    return None
                wait = self._queue.wait(now)
                self._changed.wait(_LONGEST_WAIT if wait is None else min(wait, _LONGEST_WAIT))
            return None
