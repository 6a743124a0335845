"""The alerts of one action: from its episodes to the Alertmanager, and back to the reported outcomes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

from detector.actions.base import Setting
from detector.actions.episode import Episode, Outcome, OutcomeState
from detector.actions.notify.alerts import Alert, AlertBatch, Alerts, document, labels_of
from detector.actions.notify.events import FULL, UNDELIVERED
from detector.actions.notify.keeping import Keeping
from detector.actions.notify.notice import Notice, NoticeTexts
from detector.actions.notify.outbox import Delivery, Fate
from detector.actions.notify.targets import Poster
from wayside.api.actions.notify import NotifyAction, NotifyAlertmanager

_PATH = "/api/v2/alerts"


class AlertQueue:
    """Firing and resolved alerts. Guarded by the lock of the sender."""

    def __init__(
        self, notify: NotifyAction, alertmanager: NotifyAlertmanager, setting: Setting, keeping: Keeping
    ) -> None:
        self._alerts = Alerts(alertmanager.repeat.seconds, notify.give_up_after.seconds, notify.waiting)
        self._setting = setting
        self._keeping = keeping
        self._episodes: dict[str, tuple[Episode, NoticeTexts]] = {}

    def opened(self, episode: Episode, texts: NoticeTexts) -> None:
        """Add a firing alert."""
        labels = labels_of(texts, episode.rule, self._setting.holder, episode.subject, episode.id, episode.element)
        given = {"summary": texts.title, "description": texts.text}
        annotations = {name: value for name, value in given.items() if value is not None}
        now = time.time_ns()
        alert = Alert(episode.id, labels, annotations, min(episode.start_time, now), time.monotonic())
        self._episodes[episode.id] = episode, texts
        if not self._alerts.fire(alert):
            self._lose(alert, FULL)

    def over(self, episode: Episode) -> None:
        """Resolve the alert of the episode."""
        if episode.id in self._episodes:
            self._episodes[episode.id] = episode, self._episodes[episode.id][1]
            now = time.time_ns()
            end = now if episode.end_time is None else min(episode.end_time, now)
            self._alerts.over(episode.id, end, time.monotonic())

    def take(self, now: float) -> AlertBatch | None:
        """The alerts to send now."""
        return self._alerts.take(now)

    def wait(self, now: float) -> float | None:
        """Seconds until alerts are due."""
        return self._alerts.wait(now)

    def hurry(self) -> None:
        """Try undelivered alerts once more."""
        self._alerts.hurry()

    def settle(self, sent: AlertBatch, delivery: Delivery, now: float) -> None:
        """Apply the result of a request."""
        ended, given_up = self._alerts.settle(sent, delivery, now)
        if delivery.fate is Fate.REFUSED:
            self._setting.lose("alerts rejected by the Alertmanager", len(sent.alerts), delivery.why)
        for alert in given_up:
            self._lose(alert, delivery.why)
        for alert in ended:
            self._delivered(alert)
        done = {alert.episode for alert in (*ended, *given_up)}
        for alert in sent.alerts:
            if alert.episode not in done and alert.episode in self._episodes:
                text = "fires" if delivery.fate is Fate.DELIVERED else f"not delivered yet: {delivery.why}"
                self._report(alert, OutcomeState.RUNNING, text)

    def drain(self) -> None:
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
                "it was accepted only after the end of the episode, because of failures: an Alertmanager does not "
                "notify about such alerts"
            )
            self._setting.lose("alerts that were accepted too late to notify", 1, why)
            self._report(alert, OutcomeState.FAILED, why)
        self._episodes.pop(alert.episode, None)

    def _lose(self, alert: Alert, why: str) -> None:
        known = self._episodes.pop(alert.episode, None)
        if known is None:
            return
        episode, texts = known
        event = episode.started if episode.ended is None else episode.ended
        self._keeping.lose([Notice(episode.id, event, texts, time.time())], why, alert.attempts)
        outcome = Outcome(OutcomeState.FAILED, f"not delivered: {why}", missing=1, details={"attempts": alert.attempts})
        self._setting.report(episode, outcome)

    def _report(self, alert: Alert, state: OutcomeState, message: str) -> None:
        episode, _ = self._episodes[alert.episode]
        remark = "; ".join(f"{name}: {why}" for name, why in sorted(episode.unrendered.items()))
        text = f"{message} ({remark})" if message and remark else message or remark
        self._setting.report(episode, Outcome(state, text, details={"attempts": alert.attempts}))


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
