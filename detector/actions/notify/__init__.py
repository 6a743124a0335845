"""The notify action: sends notifications about the episodes of a rule.

Notify (the action's thread) ─▶ queue: EventQueue or AlertQueue ◀─ Sender (a separate thread) ─▶ target
                                  └▶ storage: journal, dead letters

Notifications wait in the queue. The sender sends one request at a time, so an endpoint that hangs delays only its own
notifications.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ClassVar, Generic, Protocol, TypeVar

from pydantic import BaseModel

from detector.actions.base import Action, ActionContext
from detector.actions.episode import Completion, Episode
from detector.actions.notify.alerts import AlertBatch, AlertQueue, AlertTarget
from detector.actions.notify.events import EventQueue
from detector.actions.notify.notice import texts
from detector.actions.notify.outbox import AttemptResult, Delivery, OutboxMessage
from detector.actions.notify.storage import NotifyStore
from detector.actions.notify.targets import HttpTarget, Target, ZenohTarget
from wayside.api.actions import notify as api

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
        """Seconds until `take` may return an item; None: not before a new item is added."""

    def record_result(self, sent: T, delivery: Delivery, now: float) -> None:
        """Apply the result of an attempt."""

    def hurry(self) -> None:
        """The detector ends soon: return each queued item once more."""


class Sender(Generic[T]):
    """The thread that sends: takes the next item from its queue, sends it, and reports the result to the queue.

    The queue makes all decisions; it does no network I/O and is only used under the lock of the sender. The lock is not
    held during sending, so a producer never waits for it.

    Runs from its start to `finish`. `send` receives the item, and a function that returns whether to give up.
    """

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
                self._queue.record_result(parcel, delivery, time.monotonic())

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


__all__ = ["Notify"]


class Notify(Action[api.NotifyAction]):
    """Enqueues notifications. The sender does the slow work: here only the disk blocks."""

    Parameters: ClassVar[type[BaseModel]] = api.NotifyAction

    def __init__(self, parameters: api.NotifyAction, context: ActionContext) -> None:
        super().__init__(parameters, context)
        self._storage = NotifyStore(context)
        name = f"notify {context.rule.name} {context.action}"
        field = f"EventRule {context.rule.name}, action {context.action}: notify"
        self._queue: EventQueue | AlertQueue
        self._sender: Sender[OutboxMessage] | Sender[AlertBatch]
        if parameters.alertmanager is None:
            target = _target(parameters, context, field)
            self._queue = events = EventQueue(parameters, context, self._storage)
            self._sender = Sender(name, events, lambda message, give_up: target.send(message.event, give_up))
        else:
            self._queue = alerts = AlertQueue(parameters, parameters.alertmanager, context, self._storage)
            self._sender = Sender(name, alerts, AlertTarget(parameters.alertmanager, field).send)

    def started(self, episode: Episode) -> None:
        """Notify of the start, unless another run of the action has done so."""
        with self._sender.changing():
            kept = self._storage.rendered(episode.id) if episode.resumed else None
            rendered = texts(episode.rendered) if kept is None else kept
            self._storage.open(episode.id, rendered)
            self._queue.opened(episode, rendered)

    def ended(self, episode: Episode) -> None:
        """Notify of the end."""
        with self._sender.changing():
            kept = None if episode.rendered_again else self._storage.rendered(episode.id)
            self._queue.over(episode, kept or texts(episode.rendered))

    def completed(self, episode: Episode, completion: Completion) -> None:
        """No further notifications of the episode follow."""
        with self._sender.changing():
            if episode.ended is not None:
                self._storage.over(episode.id)
            self._queue.completed(episode)

    def close(self) -> None:
        """Make a last attempt for the queued notifications, for a few seconds."""
        keep = self.context.closing.is_set()  # otherwise the rule no longer has this action
        self._sender.finish()
        self._queue.drain(keep)
        self._storage.close(keep)


def _target(parameters: api.NotifyAction, context: ActionContext, field: str) -> Target:
    if parameters.http is not None:
        return HttpTarget(parameters.http, f"{field}.http")
    if parameters.zenoh is not None:
        return ZenohTarget(parameters.zenoh, context.messenger)
    raise ValueError("the model requires a target")
