"""Alerts for an Alertmanager, and their outcomes: firing ones are repeated, resolved ones are sent until delivered.

An alert is identified by its labels, and those of an episode never change: alertname (the rule), detector, subject,
episode, the element of `each` where there is one, and the rule's own. Without an update for four times `repeat` the
Alertmanager resolves it, so no alert fires forever when a detector is lost.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from detector.actions.base import ActionContext
from detector.actions.episode import Episode, Outcome, OutcomeState
from detector.actions.notify.events import FULL, UNDELIVERED, remarked
from detector.actions.notify.notice import Notice, NoticeTexts
from detector.actions.notify.outbox import FIRST, LONGEST, LONGEST_RETRY_AFTER, AttemptResult, Delivery
from detector.actions.notify.storage import NotifyStore
from detector.actions.notify.targets import Poster
from wayside.api.actions.notify import NotifyAction, NotifyAlertmanager
from wayside.process.backoff import Backoff
from wayside.times import format_time

BATCH = 100
"""Maximum number of alerts in one request."""
_LAPSES = 4
"""An alert expires after this multiple of `repeat` without an update."""


@dataclass(eq=False, slots=True)
class Alert:
    """One episode. Times from outside are nanoseconds since the epoch; `due` and `since` are monotonic seconds."""

    episode: str
    labels: Mapping[str, str]
    annotations: Mapping[str, str]
    starts_at: int
    due: float
    ends_at: int | None = None
    since: float = 0.0
    """When it was resolved."""
    delivered: bool = False
    """Whether it was ever delivered."""
    attempts: int = 0


@dataclass(frozen=True, slots=True)
class AlertBatch:
    """The alerts of one request."""

    alerts: Sequence[Alert]
    over: frozenset[str]
    """The episodes of the resolved alerts: more may end during the request."""


def labels_of(
    texts: NoticeTexts, rule: str, holder: str, subject: str, episode: str, element: str | None
) -> dict[str, str]:
    """An alert's labels; the identifying ones take precedence over the rule's labels of the same name."""
    own = {"alertname": rule, "detector": holder, "subject": subject, "episode": episode}
    return {**texts.labels, **own, **({} if element is None else {"element": element})}


def document(alert: Alert, over: bool, now: int, repeat: float) -> dict[str, Any]:
    """The alert for the Alertmanager's API v2; `now` is nanoseconds since the epoch, `repeat` seconds."""
    ends_at = alert.ends_at if over and alert.ends_at is not None else now + int(repeat * _LAPSES * 1e9)
    return {
        "labels": {name: value for name, value in alert.labels.items() if value},
        "annotations": dict(alert.annotations),
        "startsAt": format_time(alert.starts_at),
        "endsAt": format_time(max(ends_at, alert.starts_at)),
    }


class Alerts:
    """Firing alerts, and resolved ones that are not delivered yet. `now` is in seconds of a monotonic clock."""

    def __init__(self, repeat: float, give_up_after: float, capacity: int) -> None:
        self._repeat, self._give_up_after, self._capacity = repeat, give_up_after, capacity
        self._alerts: dict[str, Alert] = {}
        self._pause = Backoff(FIRST, LONGEST)
        self._paused_until = 0.0
        self._last_tries: set[str] | None = None

    def fire(self, alert: Alert) -> bool:
        """Add the alert; False if the maximum number is reached."""
        if len(self._alerts) >= self._capacity:
            return False
        self._alerts[alert.episode] = alert
        return True

    def over(self, episode: str, ends_at: int, now: float) -> None:
        """The episode ended; resolve its alert, if there is one."""
        alert = self._alerts.get(episode)
        if alert is not None:
            alert.ends_at, alert.since, alert.due = ends_at, now, now

    def hurry(self) -> None:
        """From now on, send only undelivered alerts, once more and at once."""
        self._last_tries = set()

    def take(self, now: float) -> AlertBatch | None:
        """The alerts to send now, in one request."""
        if self._last_tries is not None:
            pending = (alert for alert in self._alerts.values() if alert.ends_at is not None or not alert.delivered)
            chosen = [alert for alert in pending if alert.episode not in self._last_tries][:BATCH]
            self._last_tries |= {alert.episode for alert in chosen}
        elif now < self._paused_until:
            return None
        else:
            chosen = [alert for alert in self._alerts.values() if alert.due <= now][:BATCH]
        over = frozenset(alert.episode for alert in chosen if alert.ends_at is not None)
        return AlertBatch(chosen, over) if chosen else None

    def wait(self, now: float) -> float | None:
        """Seconds until `take` may return alerts; None: there are none."""
        due = min((alert.due for alert in self._alerts.values()), default=None)
        return None if due is None else max(0.0, due - now, self._paused_until - now)

    def record_result(self, sent: AlertBatch, delivery: Delivery, now: float) -> tuple[list[Alert], list[Alert]]:
        """The resolved alerts that were delivered, and those that were given up; both are removed.

        Firing alerts stay: after a refusal they are sent again when they are next due.
        """
        if delivery.result is AttemptResult.AGAIN:
            self._paused_until = now + max(min(delivery.retry_after, LONGEST_RETRY_AFTER), self._pause.fail())
        else:
            self._pause.succeed()
        ended: list[Alert] = []
        given_up: list[Alert] = []
        for alert in sent.alerts:
            alert.attempts += 1
            if alert.episode in sent.over:
                if delivery.result is AttemptResult.DELIVERED:
                    ended.append(alert)
                elif delivery.result is AttemptResult.REFUSED or now - alert.since >= self._give_up_after:
                    given_up.append(alert)
                continue
            alert.delivered |= delivery.result is AttemptResult.DELIVERED
            if alert.ends_at is None and delivery.result is not AttemptResult.AGAIN:
                alert.due = now + self._repeat
        for alert in (*ended, *given_up):
            self._alerts.pop(alert.episode, None)
        return ended, given_up

    def drain(self) -> list[Alert]:
        """Remove and return all alerts."""
        drained = list(self._alerts.values())
        self._alerts.clear()
        return drained


_PATH = "/api/v2/alerts"


class AlertQueue:
    """Firing and resolved alerts. Guarded by the lock of the sender."""

    def __init__(
        self, notify: NotifyAction, alertmanager: NotifyAlertmanager, context: ActionContext, storage: NotifyStore
    ) -> None:
        self._alerts = Alerts(alertmanager.repeat.seconds, notify.give_up_after.seconds, notify.waiting)
        self._context = context
        self._storage = storage
        self._episodes: dict[str, tuple[Episode, NoticeTexts]] = {}

    def opened(self, episode: Episode, texts: NoticeTexts) -> None:
        """Add a firing alert."""
        labels = labels_of(texts, episode.rule, self._context.holder, episode.subject, episode.id, episode.element)
        given = {"summary": texts.title, "description": texts.text}
        annotations = {name: value for name, value in given.items() if value is not None}
        now = time.time_ns()
        alert = Alert(episode.id, labels, annotations, min(episode.start_time, now), time.monotonic())
        self._episodes[episode.id] = episode, texts
        if not self._alerts.fire(alert):
            self._lose(alert, FULL)

    def over(self, episode: Episode, texts: NoticeTexts) -> None:
        """Resolve the alert of the episode; its texts stay those of the start."""
        if episode.id in self._episodes:
            self._episodes[episode.id] = episode, self._episodes[episode.id][1]
            now = time.time_ns()
            end = now if episode.end_time is None else min(episode.end_time, now)
            self._alerts.over(episode.id, end, time.monotonic())

    def completed(self, episode: Episode) -> None:
        """Nothing to do: an alert is resolved when its episode ends."""

    def take(self, now: float) -> AlertBatch | None:
        """The alerts to send now."""
        return self._alerts.take(now)

    def wait(self, now: float) -> float | None:
        """Seconds until alerts are due."""
        return self._alerts.wait(now)

    def hurry(self) -> None:
        """Try undelivered alerts once more."""
        self._alerts.hurry()

    def record_result(self, sent: AlertBatch, delivery: Delivery, now: float) -> None:
        """Apply the result of a request."""
        ended, given_up = self._alerts.record_result(sent, delivery, now)
        if delivery.result is AttemptResult.REFUSED:
            self._context.lose("alerts rejected by the Alertmanager", len(sent.alerts), delivery.why)
        for alert in given_up:
            self._lose(alert, delivery.why)
        for alert in ended:
            self._delivered(alert)
        done = {alert.episode for alert in (*ended, *given_up)}
        for alert in sent.alerts:
            if alert.episode not in done and alert.episode in self._episodes:
                text = "fires" if delivery.result is AttemptResult.DELIVERED else f"not delivered yet: {delivery.why}"
                self._report(alert, OutcomeState.RUNNING, text)

    def drain(self, keep: bool) -> None:
        """Remove all alerts at the end: undelivered ones are lost; firing ones expire, or continue after a restart."""
        for alert in self._alerts.drain():
            if alert.delivered and alert.ends_at is None:
                self._report(
                    alert,
                    OutcomeState.DONE,
                    "the episode had not ended: its alert expires unless the detector restores the episode at its "
                    "next start",
                )
            else:
                self._lose(alert, UNDELIVERED)

    def _delivered(self, alert: Alert) -> None:
        if alert.delivered or alert.attempts == 1:
            self._report(alert, OutcomeState.DONE, "")
        else:
            why = (
                "the Alertmanager accepted the alert only after the end of the episode, because of failures: it does "
                "not notify about such alerts"
            )
            self._context.lose("alerts that were accepted too late to notify", 1, why)
            self._report(alert, OutcomeState.FAILED, why)
        self._episodes.pop(alert.episode, None)

    def _lose(self, alert: Alert, why: str) -> None:
        known = self._episodes.pop(alert.episode, None)
        if known is None:
            return
        episode, texts = known
        event = episode.started if episode.ended is None else episode.ended
        self._storage.lose([Notice(episode.id, event, texts, time.time())], why, alert.attempts)
        outcome = Outcome(OutcomeState.FAILED, f"not delivered: {why}", missing=1, details={"attempts": alert.attempts})
        self._context.report(episode, outcome)

    def _report(self, alert: Alert, state: OutcomeState, message: str) -> None:
        episode, _ = self._episodes[alert.episode]
        self._context.report(episode, Outcome(state, remarked(message, episode), details={"attempts": alert.attempts}))


class AlertTarget:
    """Posts alerts."""

    def __init__(self, alertmanager: NotifyAlertmanager, field: str) -> None:
        self._poster = Poster(alertmanager, field)
        self._url = alertmanager.url.rstrip("/").removesuffix(_PATH) + _PATH
        self._repeat = alertmanager.repeat.seconds

    def send(self, batch: AlertBatch, give_up: Callable[[], bool]) -> Delivery:
        """Try once."""
        now = time.time_ns()
        documents = [document(alert, alert.episode in batch.over, now, self._repeat) for alert in batch.alerts]
        body = json.dumps(documents, separators=(",", ":"), ensure_ascii=False).encode()
        return self._poster.post(self._url, {"Content-Type": "application/json"}, body, give_up)
