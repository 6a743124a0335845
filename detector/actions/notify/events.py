"""CloudEvents to send: stored, grouped, sent, and finally delivered or dead letters; and the outcome by episode."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from detector.actions.base import ActionContext
from detector.actions.episode import Episode, Outcome, OutcomeState
from detector.actions.notify.notice import Notice, NoticeTexts, event_of, event_of_group
from detector.actions.notify.outbox import AttemptResult, Delivery, Outbox, OutboxMessage, RateLimit
from detector.actions.notify.storage import NotifyStore
from detector.actions.notify.targets import event_json
from wayside.api.actions.notify import NotifiedEvent, NotifyAction


@dataclass(slots=True)
class _Entry:
    episode: Episode | None = None
    """None: the episode is from before the restart."""
    open: bool = False
    waiting: int = 0
    delivered: int = 0
    attempts: int = 0
    bytes: int = 0
    failures: list[str] = field(default_factory=list)


def remarked(message: str, episode: Episode) -> str:
    """The message, with the reasons why templates of the episode could not be rendered."""
    remark = "; ".join(f"{name}: {why}" for name, why in sorted(episode.unrendered.items()))
    return f"{message} ({remark})" if message and remark else message or remark


class DeliveryLedger:
    """Counts by episode. An episode is finished once none of its messages is queued and no more will follow."""

    def __init__(self, report: Callable[[Episode, Outcome], None]) -> None:
        self._report = report
        self._entries: dict[str, _Entry] = {}

    def open(self, episode: Episode) -> None:
        """Register the episode."""
        entry = self._entry(episode.id)
        entry.episode, entry.open = episode, True

    def close(self, episode: str) -> None:
        """No further messages of the episode will follow."""
        if episode in self._entries:
            self._entries[episode].open = False
            self._report_finished(episode)

    def expect(self, episode: str) -> None:
        """A message of the episode was queued."""
        self._entry(episode).waiting += 1

    def delivered(self, episode: str, size: int) -> None:
        """A message of `size` bytes was delivered."""
        entry = self._entry(episode)
        entry.waiting -= 1
        entry.attempts += 1
        entry.delivered += 1
        entry.bytes += size
        if entry.open or entry.waiting:
            self._report_entry(entry, OutcomeState.RUNNING, f"{entry.delivered} delivered")
        self._report_finished(episode)

    def retried(self, episode: str, why: str) -> None:
        """A message was not delivered, and will be retried."""
        entry = self._entry(episode)
        entry.attempts += 1
        self._report_entry(entry, OutcomeState.RUNNING, f"not delivered yet: {why}")

    def kept(self, episode: str) -> None:
        """A message is left for the next start of the detector."""
        entry = self._entry(episode)
        self._report_entry(entry, OutcomeState.RUNNING, "not delivered yet: the detector retries after its next start")

    def failed(self, episode: str, why: str) -> None:
        """A message was given up."""
        entry = self._entry(episode)
        entry.waiting -= 1
        entry.attempts += 1
        entry.failures.append(why)
        if entry.open or entry.waiting:
            self._report_entry(entry, OutcomeState.RUNNING, f"not delivered: {why}")
        self._report_finished(episode)

    def _entry(self, episode: str) -> _Entry:
        return self._entries.setdefault(episode, _Entry())

    def _report_finished(self, episode: str) -> None:
        """Report the outcome of the episode, if it is finished."""
        entry = self._entries[episode]
        if entry.open or entry.waiting > 0:
            return
        del self._entries[episode]
        if entry.failures:
            self._report_entry(entry, OutcomeState.FAILED, "not delivered: " + "; ".join(dict.fromkeys(entry.failures)))
        else:
            self._report_entry(entry, OutcomeState.DONE, "" if entry.delivered else "there was nothing to send")

    def _report_entry(self, entry: _Entry, state: OutcomeState, message: str) -> None:
        if entry.episode is None:
            return
        text = remarked(message, entry.episode)
        details = {"messages": entry.delivered, "attempts": entry.attempts}
        lost = len(entry.failures)
        self._report(entry.episode, Outcome(state, text, bytes=entry.bytes, missing=lost, details=details))


UNDELIVERED = "the detector stopped, or the action was removed from the rule, before the event was delivered"
FULL = "the queue is full (waiting)"


class EventQueue:
    """The events of one action, up to their delivery. Guarded by the lock of the sender."""

    def __init__(self, notify: NotifyAction, context: ActionContext, storage: NotifyStore) -> None:
        rate, grouping = notify.rate, notify.grouping
        budget = None if rate is None else RateLimit(rate.messages, rate.per.seconds)
        self._outbox = Outbox(notify.waiting, notify.give_up_after.seconds, budget)
        self._grouping = grouping
        self._groups = None if grouping is None else Groups(grouping.by, grouping.wait.seconds)
        self._action = context.action
        self._moments = notify.moments
        self._storage = storage
        self._hurrying = False
        self.ledger = DeliveryLedger(context.report)
        for notice in storage.waiting():
            self._admit(notice, time.monotonic())

    def opened(self, episode: Episode, rendered: NoticeTexts) -> None:
        """Register the episode, and enqueue its start."""
        self.ledger.open(episode)
        if not episode.resumed:
            self._add(NotifiedEvent.STARTED, episode, episode.started, rendered)

    def over(self, episode: Episode, rendered: NoticeTexts) -> None:
        """Enqueue the end of the episode."""
        if episode.ended is not None:
            self._add(NotifiedEvent.ENDED, episode, episode.ended, rendered)

    def completed(self, episode: Episode) -> None:
        """No further events of the episode follow."""
        self.ledger.close(episode.id)

    def _add(self, moment: NotifiedEvent, episode: Episode, event: Mapping[str, Any], rendered: NoticeTexts) -> None:
        if moment in self._moments:
            notice = Notice(episode.id, event, rendered, time.time())
            self._storage.store(notice)
            self._admit(notice, time.monotonic())

    def _admit(self, notice: Notice, now: float) -> None:
        self.ledger.expect(notice.episode)
        if self._groups is None:
            self._post([notice])
        else:
            self._groups.add(notice, now)
            self._close_groups(now)

    def _close_groups(self, now: float) -> None:
        if self._groups is not None:
            for notices in self._groups.closed(now, everything=self._hurrying):
                self._post(notices)

    def _post(self, notices: Sequence[Notice]) -> None:
        if self._grouping is None:
            event = event_of(notices[0])
        else:
            event = event_of_group(notices, self._action, self._grouping.by, self._grouping.max_events)
        message = OutboxMessage(event, notices)
        if not self._outbox.add(message):
            self._lose(message, FULL)

    def take(self, now: float) -> OutboxMessage | None:
        """The message to send now."""
        self._close_groups(now)
        return self._outbox.take(now)

    def wait(self, now: float) -> float | None:
        """Seconds until a message or a group is due."""
        group = None if self._groups is None else self._groups.next_due()
        waits = [self._outbox.wait(now), None if group is None else max(0.0, group - now)]
        return min((wait for wait in waits if wait is not None), default=None)

    def record_result(self, sent: OutboxMessage, delivery: Delivery, now: float) -> None:
        """Apply the result of an attempt."""
        result = self._outbox.record_result(sent, delivery, now, time.time())
        if result is AttemptResult.DELIVERED:
            size = len(event_json(sent.event))
            for notice in sent.notices:
                self.ledger.delivered(notice.episode, size)
            self._storage.delivered(sent.notices)
        elif result is AttemptResult.REFUSED:
            attempts = f"after {sent.attempts} attempts, " if delivery.result is AttemptResult.AGAIN else ""
            self._lose(sent, f"{attempts}{delivery.why}")
        else:
            for episode in sent.episodes:
                self.ledger.retried(episode, delivery.why)

    def hurry(self) -> None:
        """Close all groups at once, and try each message once more."""
        self._hurrying = True
        self._close_groups(0.0)
        self._outbox.hurry()

    def drain(self, keep: bool) -> None:
        """Remove all events at the end. With `keep`, stored ones are sent after the next start; the others are lost."""
        for message in self._outbox.drain():
            if keep and all(map(self._storage.is_stored, message.notices)):
                for episode in message.episodes:
                    self.ledger.kept(episode)
            else:
                self._lose(message, UNDELIVERED)

    def _lose(self, message: OutboxMessage, why: str) -> None:
        self._storage.lose(message.notices, why, message.attempts)
        for notice in message.notices:
            self.ledger.failed(notice.episode, why)


MOST = 10_000
"""Maximum number of events in all groups together; beyond it, the oldest group is closed early."""


@dataclass(slots=True)
class _Group:
    due: float
    notices: list[Notice] = field(default_factory=list)


class Groups:
    """Open groups, by the values of the grouping labels. Times are seconds of any one clock."""

    def __init__(self, by: Sequence[str], wait: float, most: int = MOST) -> None:
        self._by, self._wait, self._most = tuple(by), wait, most
        self._open: dict[tuple[str, ...], _Group] = {}
        self._count = 0

    def add(self, notice: Notice, now: float) -> None:
        """Add it to its group, which is opened if necessary."""
        key = tuple(notice.texts.labels.get(name, "") for name in self._by)
        if key not in self._open:
            self._open[key] = _Group(now + self._wait)
        self._open[key].notices.append(notice)
        self._count += 1

    def closed(self, now: float, everything: bool = False) -> list[list[Notice]]:
        """Remove and return the groups that are due, in the order in which they were opened."""
        found: list[list[Notice]] = []
        for key, group in list(self._open.items()):
            if everything or group.due <= now or self._count > self._most:
                del self._open[key]
                self._count -= len(group.notices)
                found.append(group.notices)
        return found

    def next_due(self) -> float | None:
        """When the next group is due; None: there is none."""
        return min((group.due for group in self._open.values()), default=None)
