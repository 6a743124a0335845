"""The holder's Lease: the heartbeat by which the manager knows that the holder's demands still count.

At most one process emits tasks as a holder. The process named by the Lease (`holderIdentity`) renews it. Another
process with the same holder waits until it has itself observed the Lease unchanged for its duration, so the clocks of
two machines are never compared. A process takes over at once

- a released Lease: an orderly end clears only the identity, so that the manager keeps the demands for
  the usual time;
- a Lease of its own predecessor: in a pod, one of the same pod (a container that was restarted); elsewhere, a
  process of the same machine that is no longer alive. A restart after a crash thus finds its tasks while the manager
  still counts them.

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
from pathlib import Path

from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, RequestError
from wayside.kubernetes.leases import DEFAULT_DURATION, HOLDER_LEASE_LABEL, LeaseCandidate, lease_name
from wayside.kubernetes.resources import LEASES
from wayside.process.backoff import Backoff, retry_async

_log = logging.getLogger(__name__)

_RELEASE_DEADLINE = 2.0
"""Seconds that the end of the process may wait for an API server that does not respond."""

Owner = dict[str, str]
"""An ownerReference."""


@dataclass(frozen=True)
class ProcessIdentity:
    """The identity of this process, as the holder of a Lease."""

    text: str
    """The text of `holderIdentity`."""
    owner: Owner | None = None
    """The own pod."""

    @classmethod
    def of_this_process(cls) -> ProcessIdentity:
        """The pod by the downward API; elsewhere the machine, its process namespace and the process."""
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
        client: Client,
        namespace: str,
        holder: str,
        identity: ProcessIdentity | None = None,
        *,
        duration: float = DEFAULT_DURATION,
        monotonic: Callable[[], float] = time.monotonic,
        now: Callable[[], float] = time.time,
    ) -> None:
        """Prepare.

        Args:
            client: for the API server.
            namespace: the detector's.
            holder: the holder of the Lease.
            identity: the identity of this process. Default: `ProcessIdentity.of_this_process`.
            duration: seconds for which a renewal holds; whole, at least 3. Renewed after each third of it.
            monotonic: seconds, for observing.
            now: seconds since the epoch, only for the written times; nothing is computed from it.
        """
        self.name = lease_name(holder)
        self._client = client
        self._namespace = namespace
        self._identity = identity or ProcessIdentity.of_this_process()
        self._duration = duration
        self._monotonic = monotonic
        self._now = now
        self._candidate = LeaseCandidate(self._identity.text, round(duration), duration)
        self._refused_by = ""
        self._backoff = Backoff(0.2, duration / 3)
        self._stopping = asyncio.Event()
        self.held = asyncio.Event()
        """Set while this process may emit tasks. Cleared when the Lease expires: another process may hold it then."""
        self.attempts = 0
        """Number of attempts to renew or acquire it."""
        self.failures = 0
        """Number of failed attempts."""

    async def run(self) -> None:
        """Acquire and renew until `stop`, then release."""
        while not self._stopping.is_set():
            delay = await retry_async(self._once, RequestError, self._failed, self._pause)
            self._backoff.succeed()
            await self._pause(delay)
        await self._release()

    def stop(self) -> None:
        """End `run`, which releases the Lease."""
        self._stopping.set()

    def _failed(self, error: RequestError) -> float:
        if not self._backoff.failures:
            _log.warning("cannot renew the Lease %s; retrying with backoff: %s", self.name, error)
        self.failures += 1
        if self.held.is_set() and self._candidate.remaining(self._monotonic()) <= 0:
            self.held.clear()
            _log.error("the Lease %s has expired; this process changes no tasks until it renews the Lease", self.name)
        return self._backoff.fail(error.retry_after or 0.0)

    async def _pause(self, seconds: float) -> None:
        with suppress(TimeoutError):
            await asyncio.wait_for(self._stopping.wait(), seconds)

    async def _once(self) -> float:
        """Acquire or renew it, unless another process holds it; returns the seconds until the next attempt."""
        if self._stopping.is_set():
            return 0.0
        self.attempts += 1
        candidate, lease = self._candidate, await self._client.get(LEASES, self._namespace, self.name)
        candidate.observe(lease, self._monotonic())
        if lease is None or self._identity.succeeds(candidate.holder) or candidate.may_take(self._monotonic()):
            return await self._write(new=lease is None)
        return self._other()

    async def _write(self, *, new: bool) -> float:
        body = self._candidate.draft(self.name, self._namespace, self._now())
        metadata = body["metadata"]
        metadata["labels"] = {**(metadata.get("labels") or {}), HOLDER_LEASE_LABEL: "true"}
        if self._identity.owner:
            metadata["ownerReferences"] = [self._identity.owner]
        sent = self._monotonic()
        try:
            stored = await (self._client.create if new else self._client.replace)(LEASES, body)
        except ApiError as error:
            if error.code not in (404, 409):
                raise
            return 0.1  # another process was faster: read it again
        self._candidate.took(stored, sent, self._monotonic())
        if not self.held.is_set():
            _log.info("holding the Lease %s as %s", self.name, self._identity.text)
        self._refused_by = ""
        self.held.set()
        return self._duration / 3

    def _other(self) -> float:
        holder = self._candidate.holder
        if self.held.is_set():
            self.held.clear()
            _log.error(
                (
                    "process %s took over the Lease %s, because this process (%s) did not renew the Lease; this "
                    "process creates no tasks until it holds the Lease again"
                ),
                holder,
                self.name,
                self._identity.text,
            )
        elif holder != self._refused_by:
            _log.warning(
                (
                    "the Lease %s is held by %s: either another detector with the same name is running (stop or "
                    "rename one of them), or a previous process was just killed. This process (%s) creates "
                    "no tasks until the Lease expires, %g s after its last renewal"
                ),
                self.name,
                holder,
                self._identity.text,
                self._candidate.lasts,
            )
        self._refused_by = holder
        return min(1.0, self._duration / 3)

    async def _release(self) -> None:
        """Clear the identity, so that a successor need not wait."""
        if not self.held.is_set():
            return
        self.held.clear()
        with suppress(RequestError, TimeoutError):  # then it expires
            async with asyncio.timeout(_RELEASE_DEADLINE):
                self._candidate.observe(await self._client.get(LEASES, self._namespace, self.name), self._monotonic())
                draft = self._candidate.released(self._now())
                if draft is not None:
                    await self._client.replace(LEASES, draft)


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
