"""The notify action: sends notifications about the episodes of a rule.

Notify (the action's thread) ─▶ queue: EventQueue or AlertQueue ◀─ Sender (a separate thread) ─▶ target
                                  └▶ keeping: journal, dead letters

Notifications wait in the queue. The sender sends one request at a time, so an endpoint that hangs delays only its own
notifications.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any, ClassVar

from pydantic import BaseModel

from detector.actions.base import Action, Setting
from detector.actions.episode import Completion, Episode
from detector.actions.notify.alerts import AlertBatch, AlertQueue, AlertTarget
from detector.actions.notify.events import EventQueue
from detector.actions.notify.keeping import Keeping
from detector.actions.notify.notice import Notice, NoticeTexts, texts
from detector.actions.notify.outbox import Delivery, OutboxMessage
from detector.actions.notify.sender import Sender
from detector.actions.notify.targets import HttpTarget, Target, ZenohTarget
from wayside.api.actions import notify as api
from wayside.api.actions.notify import Moment

__all__ = ["Notify"]


class Notify(Action[api.NotifyAction]):
    """Enqueues notifications. The sender does the slow work: here only the disk blocks."""

    Parameters: ClassVar[type[BaseModel]] = api.NotifyAction

    def __init__(self, parameters: api.NotifyAction, setting: Setting) -> None:
        super().__init__(parameters, setting)
        self._keeping = Keeping(setting)
        name = f"notify {setting.rule.name} {setting.action}"
        field = f"EventRule {setting.rule.name}, action {setting.action}: notify"
        self._work: _Events | _Alerts
        if parameters.alertmanager is None:
            self._work = _Events(parameters, setting, self._keeping, name, _target(parameters, setting, field))
        else:
            self._work = _Alerts(parameters, parameters.alertmanager, setting, self._keeping, name, field)

    def started(self, episode: Episode) -> None:
        """Notify of the start, unless another run of the action has done so."""
        with self._work.changing():
            kept = self._keeping.rendered(episode.id) if episode.resumed else None
            rendered = texts(episode.rendered) if kept is None else kept
            self._keeping.open(episode.id, rendered)
            self._work.started(episode, rendered)

    def ended(self, episode: Episode) -> None:
        """Notify of the end."""
        with self._work.changing():
            kept = None if episode.rendered_again else self._keeping.rendered(episode.id)
            self._work.ended(episode, kept or texts(episode.rendered))

    def completed(self, episode: Episode, completion: Completion) -> None:
        """No further notifications of the episode follow."""
        with self._work.changing():
            if episode.ended is not None:
                self._keeping.over(episode.id)
            self._work.completed(episode)

    def close(self) -> None:
        """Make a last attempt for the queued notifications, for a few seconds."""
        keep = self.setting.closing.is_set()  # otherwise the rule no longer has this action
        self._work.close(keep)
        self._keeping.close(keep)


class _Events:
    """Notifications as CloudEvents."""

    def __init__(
        self, parameters: api.NotifyAction, setting: Setting, keeping: Keeping, name: str, target: Target
    ) -> None:
        self._moments = parameters.moments
        self._queue = EventQueue(parameters, setting, keeping)

        def send(message: OutboxMessage, give_up: Callable[[], bool]) -> Delivery:
            return target.send(message.event, give_up)

        self._sender = Sender(name, self._queue, send)

    def changing(self) -> AbstractContextManager[None]:
        return self._sender.changing()

    def started(self, episode: Episode, rendered: NoticeTexts) -> None:
        self._queue.opened(episode)
        if not episode.resumed:
            self._notify(Moment.STARTED, episode, episode.started, rendered)

    def ended(self, episode: Episode, rendered: NoticeTexts) -> None:
        if episode.ended is not None:
            self._notify(Moment.ENDED, episode, episode.ended, rendered)

    def completed(self, episode: Episode) -> None:
        self._queue.ledger.close(episode.id)

    def close(self, keep: bool) -> None:
        self._sender.finish()
        self._queue.drain(keep)

    def _notify(self, moment: Moment, episode: Episode, event: Mapping[str, Any], rendered: NoticeTexts) -> None:
        if moment in self._moments:
            self._queue.add(Notice(episode.id, event, rendered, time.time()), time.monotonic())


class _Alerts:
    """Notifications through an Alertmanager."""

    def __init__(
        self,
        parameters: api.NotifyAction,
        alertmanager: api.NotifyAlertmanager,
        setting: Setting,
        keeping: Keeping,
        name: str,
        field: str,
    ) -> None:
        self._queue = AlertQueue(parameters, alertmanager, setting, keeping)
        self._sender: Sender[AlertBatch] = Sender(name, self._queue, AlertTarget(alertmanager, field).send)

    def changing(self) -> AbstractContextManager[None]:
        return self._sender.changing()

    def started(self, episode: Episode, rendered: NoticeTexts) -> None:
        self._queue.opened(episode, rendered)

    def ended(self, episode: Episode, rendered: NoticeTexts) -> None:
        self._queue.over(episode)

    def completed(self, episode: Episode) -> None:
        """Nothing to do: an alert is resolved when its episode ends."""

    def close(self, keep: bool) -> None:
        self._sender.finish()
        self._queue.drain()


def _target(parameters: api.NotifyAction, setting: Setting, field: str) -> Target:
    if parameters.http is not None:
        return HttpTarget(parameters.http, f"{field}.http")
    if parameters.zenoh is not None:
        return ZenohTarget(parameters.zenoh, setting.messenger)
    raise ValueError("the model requires a target")
