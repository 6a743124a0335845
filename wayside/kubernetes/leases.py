"""Leases: the names of holders' Leases, and which of several processes holds one. Pure.

Each process judges a Lease on its own monotonic clock. The holder renews the Lease and may act until a deadline after
it *sent* its last renewal that was taken. Another process takes the Lease once it has itself *observed it unchanged*
for its duration, or at once where it was released. Since a renewal is sent before anyone can observe it and the
deadline is shorter than the duration, the old one has stopped before a new one begins, whatever their clocks show and
however long either was stopped: every write of the Lease carries the resourceVersion that was read, so only one of two
can succeed. No time written by others is believed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wayside.times import format_seconds

PREFIX = "wayside-"
"""The prefix of the names of all holders' Leases."""

HOLDER_LEASE_LABEL = "wayside.dev/holder-lease"
"""On all holders' Leases, with the value `true`: the manager watches these alone, and not those of every node."""

DEFAULT_DURATION = 15.0
"""The default duration of a Lease, in seconds, if the Lease does not specify one."""

_ANCIENT = float("-inf")


def lease_name(holder: str) -> str:
    """The name of the holder's Lease."""
    return PREFIX + holder


def holder_of(name: str) -> str | None:
    """Whose Lease has this name; None where it is no holder's."""
    return name.removeprefix(PREFIX) if name.startswith(PREFIX) else None


@dataclass(slots=True)
class LeaseCandidate:
    """What one process knows of the Lease, and until when it may act. Times are seconds of its monotonic clock.

    Attributes:
        identity: who it is; a container that is started again in its pod is the same, since the former has ended.
        duration: seconds that a Lease must be observed unchanged before another process takes it; whole, as the API
            has it.
        deadline: seconds after the sending of the last renewal in which the process may act.
        holder: who held the Lease when it was seen last; empty: nobody, or nothing was seen yet.
        until: when its time is over, unless it renews.
    """

    identity: str
    duration: int
    deadline: float
    holder: str = ""
    until: float = _ANCIENT
    _seen: Mapping[str, Any] | None = None
    _since: float = _ANCIENT  # when `_seen` was observed first
    _was_held: bool = False

    def remaining(self, now: float) -> float:
        """For how many seconds it may act; none or less: it may not."""
        return self.until - now

    @property
    def created(self) -> str:
        """When the Lease was created, by the API server; empty while there is none."""
        return str(self._metadata().get("creationTimestamp", ""))

    def observe(self, lease: Mapping[str, Any] | None, now: float) -> None:
        """Note the Lease as it was read, None where there is none."""
        if _version(lease) != _version(self._seen):
            self._since = now
        self._seen = lease
        if lease is not None:
            self.holder = _spec(lease).get("holderIdentity") or ""
        self._was_held = self._was_held or bool(self.holder)
        if lease is not None and self.holder != self.identity:
            self.until = _ANCIENT  # another one, or nobody: whatever we believed is over

    def may_take(self, now: float) -> bool:
        """Whether it may write itself into the Lease: that is its own, free, or was unchanged for its duration."""
        if self.holder == self.identity:
            return True
        if self._seen is None:
            # One that vanished may have a holder that has not noticed; where none was ever seen, there is none.
            return not self._was_held or now - self._since >= self.duration
        return not self.holder or now - self._since >= self.lasts

    @property
    def lasts(self) -> float:
        """The duration of the Lease as it was seen last."""
        return float(_spec(self._seen).get("leaseDurationSeconds") or self.duration)

    def draft(self, name: str, namespace: str, time: float) -> dict[str, Any]:
        """The Lease to write, held by this process; `time` in seconds since 1970 is for people to read."""
        spec, metadata = dict(_spec(self._seen)), self._metadata() or {"name": name, "namespace": namespace}
        if spec.get("holderIdentity") != self.identity or "acquireTime" not in spec:
            spec["acquireTime"] = _micro(time)
            spec["leaseTransitions"] = int(spec.get("leaseTransitions") or 0) + (1 if self._seen is not None else 0)
        spec |= {"holderIdentity": self.identity, "leaseDurationSeconds": self.duration, "renewTime": _micro(time)}
        return _lease(metadata, spec)

    def released(self, time: float) -> dict[str, Any] | None:
        """The Lease to write so that a standby takes it at once; None where it is not this process's."""
        if self._seen is None or self.holder != self.identity:
            return None
        spec = {key: value for key, value in _spec(self._seen).items() if key != "holderIdentity"}
        return _lease(self._metadata(), spec | {"renewTime": _micro(time)})

    def took(self, stored: Mapping[str, Any], sent: float, now: float) -> None:
        """Note that the Lease, as drafted and sent at `sent`, was stored."""
        self.observe(stored, now)
        if self.holder == self.identity:
            self.until = sent + self.deadline

    def _metadata(self) -> dict[str, Any]:
        """As read, so that labels stay, and with the resourceVersion; empty where there is no Lease."""
        metadata = (self._seen or {}).get("metadata") or {}
        return {key: value for key, value in metadata.items() if key != "managedFields"}


def _lease(metadata: Mapping[str, Any], spec: Mapping[str, Any]) -> dict[str, Any]:
    return {"apiVersion": "coordination.k8s.io/v1", "kind": "Lease", "metadata": dict(metadata), "spec": dict(spec)}


def _spec(lease: Mapping[str, Any] | None) -> Mapping[str, Any]:
    return (lease or {}).get("spec") or {}


def _version(lease: Mapping[str, Any] | None) -> tuple[str, str]:
    """What any write changes."""
    metadata = (lease or {}).get("metadata") or {}
    return metadata.get("uid", ""), metadata.get("resourceVersion", "")


def _micro(time: float) -> str:
    return format_seconds(time).replace("Z", "000Z")  # the API wants microseconds
