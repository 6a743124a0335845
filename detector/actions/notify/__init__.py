"""The notify action: sends notifications about the episodes of a rule.

Notify (the action's thread) ─▶ queue: EventQueue or AlertQueue ◀─ Sender (a separate thread) ─▶ target
                                  └▶ storage: journal, dead letters

Notifications wait in the queue. The sender sends one request at a time, so an endpoint that hangs delays only its own
notifications.
"""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from detector.actions.base import Action, ActionContext
from detector.actions.episode import Completion, Episode
from detector.actions.notify.alerts import AlertBatch, AlertQueue, AlertTarget
from detector.actions.notify.events import EventQueue
from detector.actions.notify.notice import texts
from detector.actions.notify.outbox import OutboxMessage
from detector.actions.notify.sender import Sender
from detector.actions.notify.storage import NotifyStore
from detector.actions.notify.targets import HttpTarget, Target, ZenohTarget
from wayside.api.actions import notify as api

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
