"""The holder's Lease: the heartbeat by which the manager knows that the holder's demands still count.

At most one process emits tasks as a holder. The process named by the Lease (`holderIdentity`) renews it. Another
process with the same holder waits until it has itself observed the Lease unchanged for its duration, so the clocks of
two machines are never compared. A process takes over at once

- a released Lease: an orderly end clears only the identity, so that the manager keeps the demands for
  the usual time;
- a Lease of its own predecessor: in a pod, one of the same pod (a container that was restarted); elsewhere, a process
of
  the same machine that is no longer alive. A restart after a crash thus finds its tasks while the manager still
  counts them.

A Standalone detector's next pod has a different name. It waits at most one duration if the previous pod was killed,
unless the Lease was deleted with that pod, which owns it.

The identity of the pod comes from the downward API: the environment variables POD_NAME and POD_UID.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from detector.cluster.api import Api, JsonObject, Resource
from detector.cluster.errors import AlreadyExistsError, ApiError, ConflictError, NotFoundError
from wayside.backoff import Backoff
from wayside.leases import DEFAULT_DURATION, HOLDER_LEASE_LABEL, lease_name

_log = logging.getLogger(__name__)

LEASES = Resource("coordination.k8s.io/v1", "leases")

_RELEASE_DEADLINE = 2.0
"""Seconds that the end of the process may wait for an API server that does not respond."""

Owner = dict[str, str]
"""An ownerReference."""


@dataclass(frozen=True)
class Identity:
    """Identifies this process."""

    text: str
    """The text of `holderIdentity`."""
    owner: Owner | None = None
    """The own pod."""

    @classmethod
    def of_this_process(cls) -> Identity:
        """The pod from the downward API; elsewhere the machine, its process namespace and the process."""
        pod, uid = os.environ.get("POD_NAME"), os.environ.get("POD_UID")
        if pod:
            owner = {"apiVersion": "v1", "kind": "Pod", "name": pod, "uid": uid} if uid else None
            return cls(pod, owner)
        return cls(f"{_machine()}_{os.getpid()}")

    def succeeds(self, other: str) -> bool:
        """Whether this process may take over from the other at once: it is a predecessor that cannot be alive."""
        if other in {"", self.text}:
            return True
        machine, _, process = other.rpartition("_")
        return machine == _machine() and process.isdigit() and not _alive(int(process))


class HolderLease:
    """Acquires and renews the Lease `wayside-<holder>` until `stop`."""

    def __init__(
        self,
        api: Api,
        namespace: str,
        holder: str,
        identity: Identity | None = None,
        *,
        duration: float = DEFAULT_DURATION,
        monotonic: Callable[[], float] = time.monotonic,
        now: Callable[[], float] = time.time,
    ) -> None:
        """Prepare.

        Args:
            api: the connection.
            namespace: the detector's.
            holder: whose sign of life it is.
            identity: which process this is. Default: found out.
            duration: seconds for which a renewal holds; whole, at least 3. Renewed after each third of it.
            monotonic: seconds, for observing.
            now: seconds since the epoch, for what is written; nothing is computed from it.
        """
        self.name = lease_name(holder)
        self._api = api
        self._namespace = namespace
        self._identity = identity or Identity.of_this_process()
        self._duration = duration
        self._monotonic = monotonic
        self._now = now
        self._seen: tuple[str, float] | None = None
        self._refused_by = ""
        self._backoff = Backoff(0.2, duration / 3)
        self._stopping = asyncio.Event()
        self.held = asyncio.Event()
        """Set while this process may emit tasks. An outage of the API server does not clear it: no other process can
        have taken over."""
        self.attempts = 0
        """Number of attempts to renew or acquire it."""
        self.failures = 0
        """Number of failed attempts."""

    async def run(self) -> None:
        """Acquire and renew until `stop`, then release."""
        while not self._stopping.is_set():
            self.attempts += 1
            try:
                delay = await self._once()
                self._backoff.succeed()
            except ApiError as error:
                if not self._backoff.failures:
                    _log.warning("cannot renew the Lease %s; retrying with backoff: %s", self.name, error)
                self.failures += 1
                delay = self._backoff.fail()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), delay)
        await self._release()

    def stop(self) -> None:
        """Let `run` release the Lease and return."""
        self._stopping.set()

    async def _once(self) -> float:
        """Acquire or renew it, or find that another process holds it; returns the seconds until the next attempt."""
        try:
            lease = await self._api.get(LEASES, self._namespace, self.name)
        except NotFoundError:
            return await self._write(None)
        holder = str(lease["spec"].get("holderIdentity") or "")
        if self._identity.succeeds(holder) or self._lapsed(lease):
            return await self._write(lease)
        return self._other(holder, lease)

    async def _write(self, lease: JsonObject | None) -> float:
        body = self._renewed(lease)
        try:
            if lease is None:
                await self._api.create(LEASES, self._namespace, body)
            else:
                await self._api.replace(LEASES, self._namespace, self.name, body)
        except (AlreadyExistsError, ConflictError, NotFoundError):
            return 0.1  # another process was faster: read it again
        if not self.held.is_set():
            _log.info("holding the Lease %s as %s", self.name, self._identity.text)
        self._refused_by = ""
        self.held.set()
        return self._duration / 3

    def _renewed(self, lease: JsonObject | None) -> JsonObject:
        moment = datetime.fromtimestamp(self._now(), UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        spec = dict(lease["spec"]) if lease else {}
        if spec.get("holderIdentity") != self._identity.text:
            spec["acquireTime"] = moment
            spec["leaseTransitions"] = spec.get("leaseTransitions", -1) + 1
        spec |= {
            "holderIdentity": self._identity.text,
            "leaseDurationSeconds": round(self._duration),
            "renewTime": moment,
        }
        metadata: JsonObject = dict(lease["metadata"]) if lease else {"name": self.name}
        metadata["labels"] = {**(metadata.get("labels") or {}), HOLDER_LEASE_LABEL: "true"}
        if self._identity.owner:
            metadata["ownerReferences"] = [self._identity.owner]
        return {"apiVersion": LEASES.api_version, "kind": "Lease", "metadata": metadata, "spec": spec}

    def _lapsed(self, lease: JsonObject) -> bool:
        """Whether we have observed the Lease unchanged for its duration."""
        version, now = lease["metadata"]["resourceVersion"], self._monotonic()
        if self._seen is None or self._seen[0] != version:
            self._seen = (version, now)
            return False
        return now - self._seen[1] >= float(lease["spec"].get("leaseDurationSeconds") or self._duration)

    def _other(self, holder: str, lease: JsonObject) -> float:
        duration = lease["spec"].get("leaseDurationSeconds") or self._duration
        if self.held.is_set():
            self.held.clear()
            _log.error(
                (
                    "process %s took over the Lease %s, because this process (%s) did not renew it; it creates "
                    "no more tasks until it holds the Lease again"
                ),
                holder,
                self.name,
                self._identity.text,
            )
        elif holder != self._refused_by:
            _log.warning(
                (
                    "the Lease %s is held by %s: either another detector with the same name is running (stop "
                    "or rename one of them), or that process has just been killed; this process (%s) creates "
                    "no tasks until the Lease has not been renewed for %g s"
                ),
                self.name,
                holder,
                self._identity.text,
                duration,
            )
        self._refused_by = holder
        return min(1.0, self._duration / 3)

    async def _release(self) -> None:
        """Clear the identity, so that a successor need not wait."""
        if not self.held.is_set():
            return
        self.held.clear()
        with suppress(ApiError, TimeoutError):  # otherwise it expires
            async with asyncio.timeout(_RELEASE_DEADLINE):
                lease = await self._api.get(LEASES, self._namespace, self.name)
                if lease["spec"].get("holderIdentity") == self._identity.text:
                    lease["spec"]["holderIdentity"] = None
                    await self._api.replace(LEASES, self._namespace, self.name, lease)


def _machine() -> str:
    """The host and its process namespace, in which process ids are unique."""
    try:
        namespace = str(Path("/proc/self/ns/pid").stat().st_ino)
    except OSError:  # no Linux
        namespace = "0"
    return f"{socket.gethostname()}_{namespace}"


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # a process of another user
    return True
