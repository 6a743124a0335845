"""Alerts in the Alertmanager's form: firing alerts are repeated, resolved ones are sent until delivered. Pure.

An alert is identified by its labels, and those of an episode never change: alertname (the rule), detector, subject,
episode, the element of `each` where there is one, and the rule's own. Without an update for four times `repeat` the
Alertmanager resolves it, so no alert fires forever when a detector is lost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from detector.actions.notify.notice import NoticeTexts
from detector.actions.notify.outbox import FIRST, LONGEST, LONGEST_RETRY_AFTER, Delivery, Fate
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
        """False: the maximum number is reached."""
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
        """Seconds until `take` may return something; None: there are no alerts."""
        due = min((alert.due for alert in self._alerts.values()), default=None)
        return None if due is None else max(0.0, due - now, self._paused_until - now)

    def settle(self, sent: AlertBatch, delivery: Delivery, now: float) -> tuple[list[Alert], list[Alert]]:
        """The resolved alerts that were delivered, and those that were given up; both are removed.

        Firing alerts stay: after a refusal they are sent again when they are next due.
        """
        if delivery.fate is Fate.AGAIN:
            self._paused_until = now + max(min(delivery.retry_after, LONGEST_RETRY_AFTER), self._pause.fail())
        else:
            self._pause.succeed()
        ended: list[Alert] = []
        given_up: list[Alert] = []
        for alert in sent.alerts:
            alert.attempts += 1
            if alert.episode in sent.over:
                if delivery.fate is Fate.DELIVERED:
                    ended.append(alert)
                elif delivery.fate is Fate.REFUSED or now - alert.since >= self._give_up_after:
                    given_up.append(alert)
                continue
            alert.delivered |= delivery.fate is Fate.DELIVERED
            if alert.ends_at is None and delivery.fate is not Fate.AGAIN:
                alert.due = now + self._repeat
        for alert in (*ended, *given_up):
            self._alerts.pop(alert.episode, None)
        return ended, given_up

    def drain(self) -> list[Alert]:
        """Remove and return all alerts."""
        drained = list(self._alerts.values())
        self._alerts.clear()
        return drained
