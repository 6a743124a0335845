"""Whether the holders of demands are alive, by their Leases and the manager's own clock.

A Lease lapses when it was *observed unchanged* for long enough, on a clock of ours that runs only while the API server
responds: the holder's clock may be wrong, and an outage stops both its renewals and our observation. Pure: the caller
passes the observations and their times.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from application_manager.core.claims.claims import Claim
from application_manager.core.claims.operations import Verdict, VerdictKind
from wayside.api import ApplicationTask, ApplicationTemplate
from wayside.api.applicationtemplate import Lifecycle, LossPolicy
from wayside.kubernetes.leases import DEFAULT_DURATION, lease_name
from wayside.times import parse_seconds

LONGEST_POLL_PAUSE = 5.0  # s between two reads of a long overdue Lease; the watch also reports a renewal
_PAUSE_SHARE = (
    0.25  # the pause between two reads as a share of the overdue time: it bounds the delay of a noticed lapse
)

HOLDER_LOST = "HolderLost"
FINISH_LOST_AFTER = 3600.0  # s for which a holder may be lost before its tasks are finished

HolderKey = tuple[str, str]
"""Namespace and holder."""


@dataclass(frozen=True, slots=True)
class LeaseView:
    """The current state of a holder's Lease.

    Attributes:
        unchanged: for how many seconds it was observed unchanged, up to the last observation.
        duration: the Lease's own duration in seconds.
        renewed: whether a change was observed since the start.
    """

    unchanged: float
    duration: float = DEFAULT_DURATION
    renewed: bool = True


class HealthyTime:
    """Seconds during which the API server responded.

    The time between two checks counts if both succeeded and were at most `longest` seconds apart; a longer gap means
    that this process itself was stopped, so that nothing is known about others.
    """

    def __init__(self, longest: float = 5.0) -> None:
        self._longest = longest
        self._last: float | None = None
        self.elapsed = 0.0

    @property
    def reached(self) -> bool:
        """Whether the last check succeeded."""
        return self._last is not None

    def note_check(self, now: float, *, succeeded: bool) -> None:
        """Note a check of the API server at `now`, in seconds of a monotonic clock."""
        if not succeeded:
            self._last = None
            return
        if self._last is not None and 0 < now - self._last <= self._longest:
            self.elapsed += now - self._last
        self._last = now


@dataclass(slots=True)
class _Observation:
    identity: str
    since: float  # healthy seconds at which it last changed
    observed: float  # healthy seconds at which it was last observed
    duration: float = DEFAULT_DURATION
    renewed: bool = False
    seen: bool = True  # otherwise only expected: the first observation is neither old nor a renewal


@dataclass(slots=True)
class LeaseIndex:
    """The observations of all Leases; times are healthy seconds (see `HealthyTime.elapsed`)."""

    _observed: dict[HolderKey, _Observation] = field(default_factory=dict)

    def observe(self, key: HolderKey, lease: Mapping[str, Any] | None, at: float) -> bool:
        """Note the current state of the holder's Lease, None if there is none; returns whether it was renewed."""
        identity = _identity(lease)
        known = self._observed.get(key)
        if known is None or (not known.seen and lease is not None):
            self._observed[key] = _Observation(identity, at, at, _duration(lease))
            return False
        known.observed, known.seen = at, True
        if identity == known.identity:
            return False
        # The deletion of a Lease is no sign of life; its creation or a change is.
        if lease is not None:
            known.since, known.renewed = at, True
            known.duration = _duration(lease)
        known.identity = identity
        return lease is not None

    def expect(self, key: HolderKey, at: float) -> None:
        """Note that a demand names the holder: it counts as observed, without a Lease, from `at` on."""
        self._observed.setdefault(key, _Observation(_identity(None), at, at, seen=False))

    def view(self, key: HolderKey) -> LeaseView:
        """The state of the holder's Lease at its last observation."""
        known = self._observed.get(key)
        if known is None:
            return LeaseView(0.0, renewed=False)
        return LeaseView(known.observed - known.since, known.duration, known.renewed)

    def due(self, key: HolderKey, at: float) -> bool:
        """Whether to read the Lease: it was unchanged for longer than its duration, as far as we know.

        A watch that broke unnoticed looks the same as a lost holder; only a read distinguishes them. The longer a Lease
        is overdue, the less often it is read, so that many lost holders cost little.
        """
        known = self._observed.get(key)
        if known is None or not known.seen:
            return True
        overdue = known.observed - known.since - known.duration
        return at - known.since >= known.duration and at - known.observed >= min(
            LONGEST_POLL_PAUSE, overdue * _PAUSE_SHARE
        )

    def seen(self, key: HolderKey) -> bool:
        """Whether the holder's Lease, or its absence, was ever observed."""
        known = self._observed.get(key)
        return known is not None and known.seen

    def forget_except(self, keys: Iterable[HolderKey]) -> None:
        """Remove the observations of holders that no longer matter."""
        kept = set(keys)
        for key in [key for key in self._observed if key not in kept]:
            del self._observed[key]


def _identity(lease: Mapping[str, Any] | None) -> str:
    """The content that a renewal changes: the Lease's spec and uid, not its labels or managed fields."""
    if lease is None:
        return ""
    uid = lease.get("metadata", {}).get("uid", "")
    return f"{uid} {json.dumps(lease.get('spec', {}), sort_keys=True)}"


def _duration(lease: Mapping[str, Any] | None) -> float:
    seconds = (lease or {}).get("spec", {}).get("leaseDurationSeconds")
    return float(seconds) if seconds else DEFAULT_DURATION


def live_claims(
    ordered: Iterable[Claim], template: ApplicationTemplate | None, leases: Mapping[str, LeaseView], now: float
) -> tuple[list[Claim], dict[str, Verdict], list[float]]:
    """The claims whose holders are not lost, the verdicts of the others, and when any of this changes by itself.

    `leases` is by holder; a missing one does not count as lost. `now` and the returned times are in seconds since 1970.
    """
    lifecycle = template.spec.lifecycle if template else Lifecycle()
    live: list[Claim] = []
    verdicts: dict[str, Verdict] = {}
    changes: list[float] = []
    for each in ordered:
        lapse, change = _lapse(each.task, lifecycle, leases, now)
        if change is not None:
            changes.append(change)
        if lapse is None:
            live.append(each)
        else:
            verdicts[each.task.name] = lapse
    return live, verdicts, changes


def _lapse(
    task: ApplicationTask, lifecycle: Lifecycle, leases: Mapping[str, LeaseView], now: float
) -> tuple[Verdict | None, float | None]:
    """The task's verdict if its holder is lost, None if it counts; and when that changes by itself.

    The status records the loss, which survives our own restart: the holder counts as lost until its Lease is observed
    to be renewed, because a new manager has not observed anything yet.
    """
    holder = task.spec.requester.holder
    view = leases.get(holder) if holder else None
    if holder is None or view is None or lifecycle.on_detector_loss.policy is LossPolicy.HOLD:
        return None, None
    limit = view.duration + lifecycle.on_detector_loss.after.seconds
    lost_since = _lost_since(task)
    if view.unchanged < limit and (view.renewed or lost_since is None):
        return None, now + limit - view.unchanged
    since = now if lost_since is None else lost_since
    if now - since >= FINISH_LOST_AFTER:
        message = f"holder {holder} has been lost for over an hour"
        return Verdict(VerdictKind.FINISHED, "DetectorLost", message), None
    message = (
        f"holder {holder} is lost: its Lease {lease_name(holder)} was not renewed for {limit:g} s; the demand "
        "counts again once the Lease is renewed"
    )
    return Verdict(VerdictKind.LAPSED, HOLDER_LOST, message), since + FINISH_LOST_AFTER


def _lost_since(task: ApplicationTask) -> float | None:
    for condition in task.status.conditions if task.status else ():
        if condition.type == "Accepted" and condition.status == "False" and condition.reason == HOLDER_LOST:
            return parse_seconds(condition.last_transition_time)
    return None
