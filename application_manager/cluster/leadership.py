"""Leader election: renews the Lease, or watches it until it can be acquired.

It has its own client, so that other requests cannot delay a renewal. The permission to write ends by a deadline, not by
a flag: after the process was suspended, the deadline has passed before any code could clear a flag.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import time
from dataclasses import dataclass

from application_manager.measures import Measures
from wayside.api.applicationtemplate import TemplateManager
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import pod_namespace
from wayside.kubernetes.errors import ApiError, RequestError, Unreachable
from wayside.kubernetes.leases import LeaseCandidate, holder_of
from wayside.kubernetes.resources import LEASES
from wayside.process.backoff import retry_async

LEASE_NAME = "application-manager"
DURATION = 12
"""Seconds for which a Lease must be unchanged before another manager acquires it."""

DEADLINE = 10.0
"""Seconds after the start of the last successful renewal during which this manager may act.

The rest of the Lease's duration is a margin for opening a connection, and for clocks that run at different speeds.
"""

RENEW_EVERY = 2.0
"""Seconds between two renewals."""

POLL_EVERY = 1.0
"""Seconds between two checks by a standby, or between two attempts after a failure."""

RENEWAL_TIMEOUT = 3.0
"""Seconds for one request about the Lease, so that after a renewal that hangs there is time for another attempt."""

log = logging.getLogger(__name__)


def steady() -> float:
    """Seconds of a clock that nobody can set, and that runs while the machine sleeps, if there is such a clock."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


@dataclass(frozen=True, slots=True)
class LeaseKey:
    """The namespace and name of the Lease that the managers of the same namespaces share."""

    namespace: str
    name: str = LEASE_NAME

    def __str__(self) -> str:
        return f"{self.namespace}/{self.name}"


def lease_key(option: str | None, namespaces: tuple[str, ...]) -> LeaseKey:
    """The Lease of the option `--lease`, `NAME` or `NAMESPACE/NAME`.

    The default namespace is that of the pod, else the first managed one, else `default`. Raises ValueError if the name
    is not valid, or is reserved for holders' Leases.
    """
    namespace, _, name = (option or LEASE_NAME).rpartition("/")
    if not name or holder_of(name) is not None:
        raise ValueError(
            f"--lease must be NAME or NAMESPACE/NAME; got {option!r}; names that begin with wayside- are reserved for "
            "detectors"
        )
    if not namespace:
        namespace = os.environ.get("POD_NAMESPACE") or pod_namespace() or next(iter(sorted(namespaces)), "default")
    return LeaseKey(namespace, name)


def own_identity() -> str:
    """The identity of this manager: its pod, so that a restarted container keeps its Lease; otherwise random."""
    pod, uid = os.environ.get("POD_NAME"), os.environ.get("POD_UID")
    return f"{pod}_{uid}" if pod and uid else f"{socket.gethostname()}_{os.getpid()}_{secrets.token_hex(4)}"


class Leadership:
    """Acquires the Lease, renews it and releases it."""

    def __init__(self, client: Client, key: LeaseKey, measures: Measures) -> None:
        """`client`: used for the Lease only."""
        self._client = client
        self._key = key
        self._measures = measures
        self._candidate = LeaseCandidate(own_identity(), DURATION, DEADLINE)
        self._changed = asyncio.Event()
        self._logged = ""
        self._was_active = False
        self._namespace_terminating = False
        self._released = False
        self._refreshing = asyncio.Lock()  # so that no renewal is in progress when the Lease is released

    def remaining(self) -> float:
        """The number of seconds for which this manager may act; 0 or less: it is not the active one."""
        return self._candidate.remaining(steady())

    @property
    def active(self) -> bool:
        """Whether this manager is the active one."""
        return self.remaining() > 0

    @property
    def lease(self) -> TemplateManager | None:
        """The Lease and its creation time, as written into statuses of templates; None while the Lease was not read."""
        created = self._candidate.created
        return TemplateManager(lease=str(self._key), since=created) if created else None

    @property
    def role(self) -> str:
        """The role of this manager for /readyz and logs; empty for the active one."""
        if self.active:
            return ""
        return f"standby: {self._candidate.holder or 'nobody'} is active"

    async def refresh(self) -> None:
        """Read the Lease, and acquire or renew it if possible. Raises ApiError or Unreachable."""
        async with self._refreshing:
            if not self._released:
                await self._refresh()

    async def _refresh(self) -> None:
        sent, candidate = steady(), self._candidate
        if not self.active:
            candidate.observe(await self._client.get(LEASES, self._key.namespace, self._key.name), steady())
            sent = steady()
            if not candidate.may_take(sent):
                self._note_role()
                return
        draft = candidate.draft(self._key.name, self._key.namespace, time.time())
        try:
            write = self._client.replace if "resourceVersion" in draft["metadata"] else self._client.create
            candidate.took(await write(LEASES, draft), sent, steady())
        except ApiError as error:
            if error.terminating:
                self._namespace_terminating = True
                self._log(logging.INFO, f"the namespace of the Lease {self._key} does not exist, or is being deleted")
                return
            if error.code not in (404, 409):
                raise
            # Another manager was first, or the Lease was deleted.
            candidate.observe(await self._client.get(LEASES, self._key.namespace, self._key.name), steady())
        self._note_role()

    async def run(self) -> None:
        """Renew or check the Lease until cancelled."""
        while True:
            await retry_async(self.refresh, RequestError, self._failed)
            await asyncio.sleep(RENEW_EVERY if self.active else POLL_EVERY)

    def _failed(self, error: RequestError) -> float:
        left = self.remaining()
        until = f"; active for {left:.0f} s more" if left > 0 else ""
        self._log(logging.WARNING, f"cannot renew the Lease {self._key}{until}: {error}", str(type(error)))
        return POLL_EVERY

    async def wait_active(self) -> None:
        """Wait until this manager is active."""
        while not self.active:
            self._changed.clear()
            await self._changed.wait()

    async def wait_over(self) -> None:
        """Wait until this manager is no longer active."""
        while (left := self.remaining()) > 0:
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), left)
            except TimeoutError:
                continue
        self._note_role()

    async def release(self) -> None:
        """Release the Lease, so that a standby acquires it immediately. Call it only after the last write.

        If this fails, the standby waits until the Lease was unchanged for its duration.
        """
        self._released = True  # so that the renewal loop does not acquire it again
        try:
            async with asyncio.timeout(RENEWAL_TIMEOUT), self._refreshing:
                draft = self._candidate.released(time.time()) if self.active else None
                self._candidate.until = 0.0
                if draft is None:
                    return
                await self._client.replace(LEASES, draft)
        except (ApiError, Unreachable, TimeoutError) as error:
            gone = isinstance(error, ApiError) and error.code in (404, 409)
            level = logging.INFO if gone else logging.WARNING  # deleted with its namespace, or acquired
            why = str(error) or "the API server does not respond"
            log.log(level, "cannot release the Lease %s; a standby takes over when it expires: %s", self._key, why)
        else:
            log.info("released the Lease %s", self._key)

    def _note_role(self) -> None:
        """Log the role when it changes."""
        active, was_active = self.active, self._was_active
        self._was_active = active
        self._measures.active(active)
        if active:
            self._namespace_terminating = False
            self._log(logging.INFO, f"active: holds the Lease {self._key} as {self._candidate.identity}")
        elif was_active:
            why = f"the Lease {self._key} was not renewed within {DEADLINE:g} s, or another manager has acquired it"
            self._log(logging.INFO if self._namespace_terminating else logging.WARNING, f"no longer active: {why}")
        else:
            self._log(logging.INFO, f"{self.role}, by the Lease {self._key}")
        self._changed.set()

    def _log(self, level: int, message: str, about: str = "") -> None:
        if self._logged != (about or message):
            self._logged = about or message
            log.log(level, "%s", message)
