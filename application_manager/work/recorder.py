"""Kubernetes Events: what happened to a task or an instance, for `kubectl describe` and `kubectl get events`.

The reasons are a fixed list. An Event follows from a change of a condition, which is stored in the cluster, so neither
a restart nor a resync tells the same again.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import socket
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from application_manager.cluster.client import EVENTS, ApiError, Client, Unreachable
from application_manager.core.conditions import changed
from application_manager.core.health.pods import TroubleReason
from application_manager.core.statuses.allowance import Allowance
from application_manager.core.statuses.conclusions import READY, STALLED
from application_manager.measures import Measures
from wayside.api.base import Condition, Kind
from wayside.times import format_seconds

COMPONENT = "wayside.dev/application-manager"
_WAITING = 1000  # Events that may wait; further ones are dropped and counted, since work goes before words
_REPORT_EVERY = 60.0  # s between two lines in the log about Events that were dropped
_NAME_LENGTH = 236  # characters of the object's name, for a pod's may have as many as the Event's
_NOTE_LENGTH = 1024  # characters, as events.k8s.io allows

log = logging.getLogger(__name__)


class Reason(StrEnum):
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


_OF_CONDITION = {
    ("Accepted", "True"): Reason.ACCEPTED,
    ("Accepted", "False"): Reason.REFUSED,
    ("Applied", "True"): Reason.APPLIED,
    ("Applied", "False"): Reason.NOT_APPLIED,
    ("Ready", "True"): Reason.READY,
    ("Ready", "False"): Reason.NOT_READY,
    ("Running", "True"): Reason.READY,
    ("Running", "False"): Reason.NOT_READY,
    ("Finished", "True"): Reason.FINISHED,
    ("Paused", "True"): Reason.PAUSED,
    ("Paused", "False"): Reason.RESUMED,
    ("Held", "True"): Reason.HELD,
    ("Suspended", "True"): Reason.SUSPENDED,
    ("Held", "False"): Reason.NOT_HELD,
}
_TROUBLES = frozenset(Reason(each.value) for each in TroubleReason)
_OWN_REASONS = frozenset(
    {
        Reason.PREEMPTED,
        Reason.LIMIT_REACHED,
        Reason.READY_TIMEOUT,
        Reason.FALLEN_BACK,
        Reason.FALLBACK_FAILED,
        Reason.HOLDER_LOST,
        Reason.TEMPLATE_INVALID,
        Reason.NOT_INJECTED,
    }
    | _TROUBLES
)
"""Reasons of conditions that are those of their Events too."""

_WARNINGS = frozenset({Reason.REFUSED, Reason.NOT_APPLIED}) | _OWN_REASONS
_EXPECTED = frozenset({"Waiting", "ChartPending", "NotApplied", "NotReady"})  # reasons that come with every start


@dataclass(frozen=True, slots=True)
class _Said:
    regarding: Kind
    reason: Reason
    note: str
    when: str
    once: bool = False


@dataclass(slots=True)
class _Drops:
    """Events that were dropped and not reported yet; reported at once, and then once a minute."""

    count: int = 0
    why: str = ""
    reported: float | None = None  # on the monotonic clock

    def note(self, why: str) -> None:
        """One was dropped."""
        self.count += 1
        self.why = why

    def due_in(self, now: float) -> float | None:
        """Seconds until a report is due; None where there is nothing to report."""
        if not self.count:
            return None
        return 0 if self.reported is None else max(0.0, self.reported + _REPORT_EVERY - now)

    def report(self, now: float) -> None:
        """Log how many there were, and why the last one was dropped."""
        log.warning("%d Events were dropped since the last report, the last one: %s", self.count, self.why)
        self.count, self.reported = 0, now


class Recorder:
    """Takes Events at once and posts them in the background."""

    def __init__(self, client: Client, measures: Measures | None = None) -> None:
        self._client = client
        self._measures = measures or Measures()
        self._allowance = Allowance()
        self._waiting: asyncio.Queue[_Said | None] = asyncio.Queue(_WAITING)
        self._ending = False
        self._instance = f"{socket.gethostname()}-{os.getpid()}"[:128]
        self._drops = _Drops()

    def say(self, regarding: Kind, reason: Reason, note: str, now: float, *, once: bool = False) -> None:
        """Post an Event about the object, unless there were too many of it.

        Args:
            regarding: the object.
            reason: one word.
            note: why, for people.
            now: seconds since 1970.
            once: not if there is the same already, also of an earlier run: for what follows from no change of a status.
        """
        if not self._allowance.takes(regarding.metadata.uid, now):
            self._measures.unposted("limited")
            return
        try:
            self._waiting.put_nowait(_Said(regarding, reason, note, format_seconds(now), once))
        except asyncio.QueueFull:
            self._measures.unposted("full")
            self._drops.note("more than could be posted")

    def transitions(self, regarding: Kind, old: Sequence[Condition], new: Sequence[Condition], now: float) -> None:
        """Post an Event for each condition that changed, if it is worth one: not yet being ready is none.

        Nor is what follows from another condition: Stalled, and Ready of what is not applied or not accepted.
        """
        was_true = {each.type for each in old if each.status == "True"}
        is_false = {each.type for each in new if each.status == "False"}
        concludes = not is_false.isdisjoint(("Applied",)) or any(each.type == "Accepted" for each in new)
        for each in changed(old, new):
            if each.type == STALLED or (each.type == READY and concludes):
                continue
            reason = _OF_CONDITION.get((each.type, each.status))
            if each.reason in _OWN_REASONS:
                reason = Reason(each.reason)
            if each.reason == Reason.NOT_SUSPENDED:
                reason = Reason.NOT_SUSPENDED
            expected = each.status == "False" and each.type not in was_true and each.reason in _EXPECTED
            if reason is not None and not expected:
                self.say(regarding, reason, each.message, now)

    def finish(self) -> None:
        """Let `run` return once what waits is posted."""
        self._ending = True
        if not self._waiting.full():
            self._waiting.put_nowait(None)  # to wake it

    async def run(self) -> None:
        """Post until cancelled, or told to finish. An Event that cannot be posted is dropped."""
        while not (self._ending and self._waiting.empty()):
            try:
                async with asyncio.timeout(self._drops.due_in(time.monotonic())):
                    said = await self._waiting.get()
            except TimeoutError:
                self._drops.report(time.monotonic())
                continue
            if said is None:
                continue
            try:
                await self._client.create(EVENTS, self._manifest(said))
                self._measures.posted(said.reason.value)
            except ApiError as error:
                if said.once and error.code == 409:
                    continue
                self._measures.unposted("failed")
                if not error.terminating:
                    self._drops.note(f"{said.reason} about {said.regarding.name}: {error}")
            except Unreachable as error:
                self._measures.unposted("failed")
                self._drops.note(str(error))
            if self._drops.due_in(now := time.monotonic()) == 0:
                self._drops.report(now)
        if self._drops.count:
            self._drops.report(time.monotonic())

    def _manifest(self, said: _Said) -> dict[str, Any]:
        regarding = said.regarding
        same = "\0".join((regarding.metadata.uid, said.reason, said.note)).encode()
        ending = hashlib.sha256(same).hexdigest() if said.once else uuid.uuid4().hex
        return {
            "apiVersion": "events.k8s.io/v1",
            "kind": "Event",
            "metadata": {
                "name": f"{regarding.name[:_NAME_LENGTH].rstrip('-.')}.{ending[:16]}",
                "namespace": regarding.namespace,
            },
            "eventTime": said.when.replace("Z", "000Z"),  # the API wants microseconds
            "reportingController": COMPONENT,
            "reportingInstance": self._instance,
            "action": "Reconcile",
            "reason": said.reason.value,
            "type": "Warning" if said.reason in _WARNINGS else "Normal",
            "note": said.note[:_NOTE_LENGTH],
            "regarding": {
                "apiVersion": regarding.api_version,
                "kind": regarding.kind,
                "namespace": regarding.namespace,
                "name": regarding.name,
                "uid": regarding.metadata.uid,
            },
        }
