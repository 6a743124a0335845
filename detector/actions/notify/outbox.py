"""Messages that wait for delivery: which is next, when, and when it is given up. Pure: the caller passes `now`.

A message that fails waits longer each time. Others overtake it, but never those of the same episode: the end is not
sent before the start. An endpoint that does not respond, or reports that it is busy, is paused as a whole.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from detector.actions.notify.notice import Notice
from wayside.process.backoff import Backoff

FIRST, LONGEST = 1.0, 300.0
"""Seconds until the second attempt, and maximum seconds between two attempts."""
LONGEST_RETRY_AFTER = 3600.0
"""Maximum seconds of a Retry-After that are respected."""


class AttemptResult(Enum):
    """The result of an attempt for the message."""

    DELIVERED = "delivered"
    AGAIN = "again"
    REFUSED = "refused"
    """It would be rejected again."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """The result of an attempt."""

    result: AttemptResult
    why: str = ""
    retry_after: float = 0.0
    """Minimum seconds until the next attempt, as the endpoint requests."""
    whole: bool = False
    """The whole endpoint is unavailable or busy; the message is not the cause."""


@dataclass(eq=False, slots=True)
class OutboxMessage:
    """One CloudEvent to deliver, and the events that it contains."""

    event: Mapping[str, Any]
    notices: Sequence[Notice]
    backoff: Backoff = field(default_factory=lambda: Backoff(FIRST, LONGEST))
    due: float = 0.0
    attempts: int = 0

    @property
    def created(self) -> float:
        """When the first of its events was created, in seconds since the epoch."""
        return min(notice.created for notice in self.notices)

    @property
    def episodes(self) -> frozenset[str]:
        """The episodes of its events."""
        return frozenset(notice.episode for notice in self.notices)


class RateLimit:
    """A rate limit: at most `messages` messages in any period of `per` seconds."""

    def __init__(self, messages: int, per: float) -> None:
        self._per = per
        self._sent: deque[float] = deque(maxlen=messages)
        """When the last messages were sent."""

    def wait(self, now: float) -> float:
        """Seconds until the next message may be sent."""
        if len(self._sent) < (self._sent.maxlen or 0):
            return 0.0
        return max(0.0, self._sent[0] + self._per - now)

    def spend(self, now: float) -> None:
        """Count a message as sent."""
        self._sent.append(now)


class Outbox:
    """At most `capacity` messages. `now` is in seconds of a monotonic clock, `wall` in seconds since the epoch."""

    def __init__(self, capacity: int, give_up_after: float, budget: RateLimit | None = None) -> None:
        self._capacity, self._give_up_after, self._budget = capacity, give_up_after, budget
        self._waiting: list[OutboxMessage] = []
        self._pause = Backoff(FIRST, LONGEST)
        self._paused_until = 0.0
        self._last_tries: set[int] | None = None
        """In the last round, the messages that were tried; None before."""

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, message: OutboxMessage) -> bool:
        """Enqueue the message; False if there is no room."""
        if len(self._waiting) >= self._capacity:
            return False
        self._waiting.append(message)
        return True

    def hurry(self) -> None:
        """From now on, try each message once more, without waiting for its time."""
        self._last_tries = set()

    def take(self, now: float) -> OutboxMessage | None:
        """The message to send now; call `record_result` with the result before the next."""
        if self._budget is not None and self._budget.wait(now) > 0:
            return None
        if self._last_tries is None and now < self._paused_until:
            return None
        for message in self._first_of_their_episodes():
            if self._is_due(message, now):
                if self._budget is not None:
                    self._budget.spend(now)
                if self._last_tries is not None:
                    self._last_tries.add(id(message))
                message.attempts += 1
                return message
        return None

    def _first_of_their_episodes(self) -> Iterator[OutboxMessage]:
        """The messages that need not wait for an earlier one of the same episode."""
        held: set[str] = set()
        for message in self._waiting:
            if not held & message.episodes:
                yield message
            held |= message.episodes

    def _is_due(self, message: OutboxMessage, now: float) -> bool:
        if self._last_tries is not None:
            return id(message) not in self._last_tries
        return message.due <= now

    def wait(self, now: float) -> float | None:
        """Seconds until `take` may return a message; None: the outbox is empty."""
        due = min((message.due for message in self._first_of_their_episodes()), default=None)
        if due is None:
            return None
        wait = max(0.0, due - now, self._paused_until - now)
        return wait if self._budget is None else max(wait, self._budget.wait(now))

    def record_result(self, message: OutboxMessage, delivery: Delivery, now: float, wall: float) -> AttemptResult:
        """Apply the result of an attempt: DELIVERED and REFUSED remove the message, AGAIN schedules a retry."""
        if not delivery.whole:
            self._pause.succeed()
        result = delivery.result
        if result is AttemptResult.AGAIN:
            wait = min(delivery.retry_after, LONGEST_RETRY_AFTER)
            message.due = now + max(wait, message.backoff.fail())
            if delivery.whole:
                self._paused_until = now + max(wait, self._pause.fail())
            if wall - message.created >= self._give_up_after:
                result = AttemptResult.REFUSED
        if result is not AttemptResult.AGAIN:
            self._waiting.remove(message)
        return result

    def drain(self) -> list[OutboxMessage]:
        """Remove and return the remaining messages."""
        drained, self._waiting = self._waiting, []
        return drained
