"""Leases: the names of holders' Leases, and the election of the one process that holds a Lease. Pure.

Each process measures time on its own monotonic clock, and ignores the times that others write. The holder renews the
Lease, and may act until a deadline after it *sent* its last successful renewal. Another process takes the Lease after
it has *observed it unchanged* for its duration, or at once if it was released. A renewal is sent before anyone can
observe it, and the deadline is not longer than the duration. So a holder that checks `remaining` stops before a new one
starts, even if clocks differ or a process was suspended. Every write of the Lease carries the resourceVersion that was
read, so only one of two concurrent writes succeeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wayside.times import format_microseconds

PREFIX = "wayside-"
"""The prefix of the names of all holders' Leases."""

HOLDER_LEASE_LABEL = "wayside.dev/holder-lease"
"""The label of all holders' Leases, with the value `true`. The manager watches only these, and not the Leases of
nodes."""

DEFAULT_DURATION = 15.0
"""The default duration of a Lease, in seconds, if the Lease does not specify one."""

_ANCIENT = float("-inf")


def lease_name(holder: str) -> str:
    """The name of the holder's Lease."""
    return PREFIX + holder


def holder_of(name: str) -> str | None:
    """The holder whose Lease has this name; None if the name is not that of a holder's Lease."""
    return name.removeprefix(PREFIX) if name.startswith(PREFIX) else None


@dataclass(slots=True)
class LeaseCandidate:
    """One process's knowledge of the Lease, and the time until which it may act, in seconds of its monotonic clock.

    Attributes:
        identity: the identity of the process. A restarted container of a pod keeps it, since its predecessor has ended.
        duration: the seconds for which a Lease must be unchanged before another process takes it; an integer, as in
            the API.
        deadline: the seconds after the last renewal was sent in which the process may act.
        holder: the last observed holder of the Lease; empty if there was none, or nothing was observed.
        until: the time at which the process must stop, unless it renews the Lease.
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
        """The number of seconds for which it may act; 0 or less: it may not."""
        return self.until - now

    @property
    def created(self) -> str:
        """The creation time of the Lease, set by the API server; empty while there is no Lease."""
        return str(self._metadata().get("creationTimestamp", ""))

    def observe(self, lease: Mapping[str, Any] | None, now: float) -> None:
        """Note the Lease as it was read; None if it does not exist."""
        if _version(lease) != _version(self._seen):
            self._since = now
        self._seen = lease
        if lease is not None:
            self.holder = _spec(lease).get("holderIdentity") or ""
        self._was_held = self._was_held or bool(self.holder)
        if lease is not None and self.holder != self.identity:
            self.until = _ANCIENT  # another holder or none: this process may no longer act

    def may_take(self, now: float) -> bool:
        """Whether it may write itself into the Lease: it is the holder, there is none, or the Lease has expired."""
        if self.holder == self.identity:
            return True
        if self._seen is None:
            # A deleted Lease may have a holder that has not noticed it yet, unless none was ever observed.
            return not self._was_held or now - self._since >= self.duration
        return not self.holder or now - self._since >= self.lasts

    @property
    def lasts(self) -> float:
        """The last observed duration of the Lease, in seconds."""
        return float(_spec(self._seen).get("leaseDurationSeconds") or self.duration)

    def draft(self, name: str, namespace: str, time: float) -> dict[str, Any]:
        """The Lease to write, held by this process. `time`, in seconds since the epoch, is only for people."""
        spec, metadata = dict(_spec(self._seen)), self._metadata() or {"name": name, "namespace": namespace}
        if spec.get("holderIdentity") != self.identity or "acquireTime" not in spec:
            spec["acquireTime"] = format_microseconds(time)
            spec["leaseTransitions"] = int(spec.get("leaseTransitions") or 0) + (1 if self._seen is not None else 0)
        spec |= {"holderIdentity": self.identity, "leaseDurationSeconds": self.duration}
        spec["renewTime"] = format_microseconds(time)
        return _lease(metadata, spec)

    def released(self, time: float) -> dict[str, Any] | None:
        """The Lease to write so that a standby takes it at once; None if this process is not its holder."""
        if self._seen is None or self.holder != self.identity:
            return None
        spec = {key: value for key, value in _spec(self._seen).items() if key != "holderIdentity"}
        return _lease(self._metadata(), spec | {"renewTime": format_microseconds(time)})

    def took(self, stored: Mapping[str, Any], sent: float, now: float) -> None:
        """Note that the Lease that was sent at `sent` is stored."""
        self.observe(stored, now)
        if self.holder == self.identity:
            self.until = sent + self.deadline

    def _metadata(self) -> dict[str, Any]:
        """The metadata as read, to keep the labels and the resourceVersion; empty if there is no Lease."""
        metadata = (self._seen or {}).get("metadata") or {}
        return {key: value for key, value in metadata.items() if key != "managedFields"}


def _lease(metadata: Mapping[str, Any], spec: Mapping[str, Any]) -> dict[str, Any]:
    return {"apiVersion": "coordination.k8s.io/v1", "kind": "Lease", "metadata": dict(metadata), "spec": dict(spec)}


def _spec(lease: Mapping[str, Any] | None) -> Mapping[str, Any]:
    return (lease or {}).get("spec") or {}


def _version(lease: Mapping[str, Any] | None) -> tuple[str, str]:
    """The part of the metadata that every write changes."""
    metadata = (lease or {}).get("metadata") or {}
    return metadata.get("uid", ""), metadata.get("resourceVersion", "")
