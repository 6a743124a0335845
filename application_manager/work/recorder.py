"""Kubernetes Events of tasks and instances, for `kubectl describe` and `kubectl get events`.

The reasons are a fixed list. An Event follows from a change of a condition, which is stored in the cluster, so neither
a restart nor a resync posts it again. A repetition updates the series of its Event, as events.k8s.io defines.
Namespaces take turns, and each has its own queue. A few Events about one object may be posted at once, then a limited
rate.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import socket
import time
import uuid
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from application_manager.core.conditions import READY, STALLED, changed
from application_manager.core.health.pods import TroubleReason
from application_manager.measures import Measures
from wayside.api.base import Condition, Kind
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, RequestError
from wayside.kubernetes.pacing import FairQueue
from wayside.kubernetes.resources import EVENTS
from wayside.times import format_microseconds

COMPONENT = "wayside.dev/application-manager"
_WAITING = 1000  # Events of a namespace that may wait; further ones are dropped and counted
_SERIES = 360.0  # s after which a repetition is a new Event, like in client-go
_REFRESHED = 60.0  # s between two changes of a series
_KEPT = 4096  # Events that are remembered, since they may be repeated

BURST = 10
"""The maximum number of Events about one object at once."""

REFILL = 60.0
"""Seconds until one more is allowed: an object that changes constantly has one Event a minute."""

_KEPT_BUCKETS = 10_000  # objects to remember; the one with the oldest Event is forgotten, and its limit starts again
_REPORT_EVERY = 60.0  # s between two log lines about dropped Events
_NAME_LENGTH = 236  # characters of the object's name in an Event's name, which has the same maximum length as a pod's
_NOTE_LENGTH = 1024  # characters, as events.k8s.io allows

log = logging.getLogger(__name__)


class EventReason(StrEnum):
    """All reasons that Events can have."""

    ACCEPTED = "Accepted"
    REFUSED = "Refused"
    HOLDER_LOST = "HolderLost"
    FINISHED = "Finished"
    APPLIED = "Applied"
    NOT_APPLIED = "NotApplied"
    READY = "Ready"
    NOT_READY = "NotReady"
    LINGERING = "Lingering"
    RELEASED = "Released"
    PREEMPTED = "Preempted"
    LIMIT_REACHED = "LimitReached"
    READY_TIMEOUT = "ReadyTimeout"
    FALLEN_BACK = "FallenBack"
    FALLBACK_FAILED = "FallbackFailed"
    TEMPLATE_INVALID = "TemplateInvalid"
    PAUSED = "Paused"
    RESUMED = "Resumed"
    HELD = "Held"
    SUSPENDED = "Suspended"
    NOT_SUSPENDED = "NotSuspended"
    NOT_HELD = "NotHeld"
    IMAGE_PULL_FAILED = "ImagePullFailed"
    CONTAINER_FAILED = "ContainerFailed"
    CRASH_LOOP = "CrashLoop"
    POD_FAILED = "PodFailed"
    UNSCHEDULABLE = "Unschedulable"
    QUOTA_EXCEEDED = "QuotaExceeded"
    ADMISSION_REFUSED = "AdmissionRefused"
    NOT_INJECTED = "NotInjected"
    MANAGERS_OVERLAP = "ManagersOverlap"


_OF_CONDITION = {
    ("Accepted", "True"): EventReason.ACCEPTED,
    ("Accepted", "False"): EventReason.REFUSED,
    ("Applied", "True"): EventReason.APPLIED,
    ("Applied", "False"): EventReason.NOT_APPLIED,
    ("Ready", "True"): EventReason.READY,
    ("Ready", "False"): EventReason.NOT_READY,
    ("Running", "True"): EventReason.READY,
    ("Running", "False"): EventReason.NOT_READY,
    ("Finished", "True"): EventReason.FINISHED,
    ("Paused", "True"): EventReason.PAUSED,
    ("Paused", "False"): EventReason.RESUMED,
    ("Held", "True"): EventReason.HELD,
    ("Suspended", "True"): EventReason.SUSPENDED,
    ("Held", "False"): EventReason.NOT_HELD,
}
_TROUBLES = frozenset(EventReason(each.value) for each in TroubleReason)
_OWN_REASONS = frozenset(
    {
        EventReason.PREEMPTED,
        EventReason.LIMIT_REACHED,
        EventReason.READY_TIMEOUT,
        EventReason.FALLEN_BACK,
        EventReason.FALLBACK_FAILED,
        EventReason.HOLDER_LOST,
        EventReason.TEMPLATE_INVALID,
        EventReason.NOT_INJECTED,
        EventReason.MANAGERS_OVERLAP,
    }
    | _TROUBLES
)
"""Reasons of conditions that are also reasons of their Events."""

_WARNINGS = frozenset({EventReason.REFUSED, EventReason.NOT_APPLIED}) | _OWN_REASONS
_EXPECTED = frozenset({"Waiting", "ChartPending", "NotApplied", "NotReady"})  # reasons that occur at every start


@dataclass(frozen=True, slots=True)
class _Event:
    regarding: Kind
    reason: EventReason
    note: str
    now: float
    once: bool = False

    @property
    def what(self) -> tuple[str, str, str]:
        """The fields that are equal in repetitions."""
        return self.regarding.metadata.uid, self.reason.value, self.note


@dataclass(slots=True)
class _Series:
    """A posted Event: its name, the number of occurrences, and the time of the last one, in seconds since 1970."""

    name: str
    count: int
    last: float
    written: float


@dataclass(slots=True)
class _Drops:
    """Counts dropped Events that are not logged yet; they are logged at once, and then once a minute."""

    count: int = 0
    why: str = ""
    reported: float | None = None  # on the monotonic clock

    def note(self, why: str) -> None:
        """Count a dropped Event."""
        self.count += 1
        self.why = why

    def due_in(self, now: float) -> float | None:
        """Seconds until the next log line; None if there is nothing to log."""
        if not self.count:
            return None
        return 0 if self.reported is None else max(0.0, self.reported + _REPORT_EVERY - now)

    def report(self, now: float) -> None:
        """Log the number of dropped Events, and why the last one was dropped."""
        log.warning("dropped %d Events since the last report; the last one: %s", self.count, self.why)
        self.count, self.reported = 0, now


class Recorder:
    """Accepts Events immediately and posts them in the background."""

    def __init__(self, client: Client, measures: Measures | None = None) -> None:
        self._client = client
        self._measures = measures or Measures()
        self._buckets = TokenBuckets()
        self._waiting: FairQueue[_Event] = FairQueue()
        self._wake = asyncio.Event()
        self._ending = False
        self._instance = f"{socket.gethostname()}-{os.getpid()}"[:128]
        self._drops = _Drops()
        self._series: OrderedDict[tuple[str, str, str], _Series] = OrderedDict()

    def event(self, regarding: Kind, reason: EventReason, note: str, now: float, *, once: bool = False) -> None:
        """Post an Event about the object, at `now` in seconds since 1970, unless the object exceeds its rate limit.

        `once`: do not post it if the same Event exists, even from an earlier run; for Events that do not follow from
        a change of a status.
        """
        event = _Event(regarding, reason, note, now, once)
        if self._count_repetition(event):
            return
        if not self._buckets.take(regarding.metadata.uid, now):
            self._measures.unposted("limited")
        elif self._waiting.count(regarding.namespace) >= _WAITING:
            self._measures.unposted("full")
            self._drops.note("more than could be posted")
        else:
            self._waiting.add(regarding.namespace, event)
            self._wake.set()

    def _count_repetition(self, event: _Event) -> bool:
        """Count the repetition of a recent Event; whether it is not written yet."""
        known = self._series.get(event.what)
        if known is None:
            return False
        if event.now - known.last > _SERIES:
            del self._series[event.what]
            return False
        known.count += 1
        known.last = event.now
        return event.now - known.written < _REFRESHED and known.count > 2

    def transitions(self, regarding: Kind, old: Sequence[Condition], new: Sequence[Condition], now: float) -> None:
        """Post an Event for each relevant change of a condition.

        A condition has no Event if it is False as expected at the start, or if it follows from another one: Stalled,
        Ready of an object that is not applied or not accepted, Applied of an object that is immediately ready. A task
        that was accepted immediately has none either: its status shows that, and its later conditions have Events.
        """
        known = {each.type for each in old}
        was_true = {each.type for each in old if each.status == "True"}
        is_false = {each.type for each in new if each.status == "False"}
        concludes = not is_false.isdisjoint(("Applied",)) or any(each.type == "Accepted" for each in new)
        changes = changed(old, new)
        at_once = {each.type for each in changes if each.status == "True"} >= {"Applied", READY}
        for each in changes:
            if each.type == STALLED or (each.type == READY and concludes) or (each.type == "Applied" and at_once):
                continue
            if (regarding.kind, each.reason) == ("ApplicationTask", EventReason.ACCEPTED) and each.type not in known:
                continue
            reason = _OF_CONDITION.get((each.type, each.status))
            if each.reason in _OWN_REASONS:
                reason = EventReason(each.reason)
            if each.reason == EventReason.NOT_SUSPENDED:
                reason = EventReason.NOT_SUSPENDED
            expected = each.status == "False" and each.type not in was_true and each.reason in _EXPECTED
            if reason is not None and not expected:
                self.event(regarding, reason, each.message, now)

    def finish(self) -> None:
        """Let `run` return once all queued Events are posted."""
        self._ending = True
        self._wake.set()

    async def run(self) -> None:
        """Post until cancelled, or finished. An Event that cannot be posted is dropped."""
        while True:
            event = self._waiting.next()
            if event is not None:
                await self._post(event)
            elif self._ending:
                break
            else:
                await self._wait()
            if self._drops.due_in(now := time.monotonic()) == 0:
                self._drops.report(now)
        if self._drops.count:
            self._drops.report(time.monotonic())

    async def _wait(self) -> None:
        """Wait for an Event, or until dropped ones are to be logged."""
        self._wake.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(self._drops.due_in(time.monotonic())):
                await self._wake.wait()

    async def _post(self, event: _Event) -> None:
        try:
            await self._write(event)
            self._measures.posted(event.reason.value)
        except ApiError as error:
            if event.once and error.code == 409:
                return
            self._measures.unposted("failed")
            if not error.terminating:
                self._drops.note(f"{event.reason} about {event.regarding.name}: {error}")
        except RequestError as error:
            self._measures.unposted("failed")
            self._drops.note(str(error))

    async def _write(self, event: _Event) -> None:
        """Post the Event, or update the series of the Event that it repeats."""
        known = self._series.get(event.what)
        if known is not None and known.count > 1:
            known.written = event.now
            series = {"count": known.count, "lastObservedTime": format_microseconds(known.last)}
            if await self._client.merge(EVENTS, event.regarding.namespace, known.name, {"series": series}):
                return
        manifest = self._manifest(event)
        await self._client.create(EVENTS, manifest)
        self._series.pop(event.what, None)
        self._series[event.what] = _Series(manifest["metadata"]["name"], 1, event.now, event.now)
        if len(self._series) > _KEPT:
            self._series.popitem(last=False)

    def _manifest(self, event: _Event) -> dict[str, Any]:
        regarding = event.regarding
        same = "\0".join((regarding.metadata.uid, event.reason, event.note)).encode()
        ending = hashlib.sha256(same).hexdigest() if event.once else uuid.uuid4().hex
        return {
            "apiVersion": "events.k8s.io/v1",
            "kind": "Event",
            "metadata": {
                "name": f"{regarding.name[:_NAME_LENGTH].rstrip('-.')}.{ending[:16]}",
                "namespace": regarding.namespace,
            },
            "eventTime": format_microseconds(event.now),
            "reportingController": COMPONENT,
            "reportingInstance": self._instance,
            "action": "Reconcile",
            "reason": event.reason.value,
            "type": "Warning" if event.reason in _WARNINGS else "Normal",
            "note": event.note[:_NOTE_LENGTH],
            "regarding": {
                "apiVersion": regarding.api_version,
                "kind": regarding.kind,
                "namespace": regarding.namespace,
                "name": regarding.name,
                "uid": regarding.metadata.uid,
            },
        }


class TokenBuckets:
    """A token bucket for each object: `BURST` at first, one more each `REFILL` seconds."""

    def __init__(self) -> None:
        self._left: OrderedDict[Hashable, tuple[float, float]] = OrderedDict()  # tokens, and when they were counted

    def take(self, key: Hashable, now: float) -> bool:
        """Take a token of the object at `now`, in seconds; whether there was one."""
        tokens, since = self._left.pop(key, (float(BURST), now))
        tokens = min(float(BURST), tokens + max(0.0, now - since) / REFILL)
        allowed = tokens >= 1
        self._left[key] = (tokens - 1 if allowed else tokens, now)
        if len(self._left) > _KEPT_BUCKETS:
            self._left.popitem(last=False)
        return allowed
