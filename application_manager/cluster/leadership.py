"""Leader election: renews the Lease, or watches it until it can be acquired.

It has a client of its own, so that no other request holds up a renewal. A time limits what may be done, never a
flag: a process that was stopped finds its time over before anything had a chance to report it.
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
"""Seconds that a Lease must be observed unchanged before another manager takes it."""

DEADLINE = 10.0
"""Seconds after the sending of the last renewal in which its manager may act. What remains of the duration is for a
connection to be opened, and for clocks that run at different speeds."""

RENEW_EVERY = 2.0
"""Seconds between two renewals."""

LOOK_EVERY = 1.0
"""Seconds between two looks of a standby, or two attempts where one failed."""

RENEWAL_TIMEOUT = 3.0
"""Seconds for one request about the Lease, so that a renewal that hangs leaves time for another."""

log = logging.getLogger(__name__)


def steady() -> float:
    """Seconds of a clock that no one sets, and that runs while the machine sleeps, where there is such a clock."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


@dataclass(frozen=True, slots=True)
class LeaseKey:
    """Where the Lease is that the managers of the same namespaces share."""

    namespace: str
    name: str = LEASE_NAME

    def __str__(self) -> str:
        return f"{self.namespace}/{self.name}"


def lease_key(given: str | None, namespaces: tuple[str, ...]) -> LeaseKey:
    """The Lease of the option `--lease`, `NAME` or `NAMESPACE/NAME`.

    The namespace is that of the pod, else the first that is managed, else `default`. Raises ValueError where the
    name is that of a holder's Lease, or none.
    """
    namespace, _, name = (given or LEASE_NAME).rpartition("/")
    if not name or holder_of(name) is not None:
        raise ValueError(
            f"--lease must be NAME or NAMESPACE/NAME; got {given!r}; names that begin with wayside- are reserved for "
            "detectors"
        )
    if not namespace:
        namespace = os.environ.get("POD_NAMESPACE") or pod_namespace() or next(iter(sorted(namespaces)), "default")
    return LeaseKey(namespace, name)


def own_identity() -> str:
    """Who this manager is: its pod, so that a container that starts again need not wait for itself; else random."""
    pod, uid = os.environ.get("POD_NAME"), os.environ.get("POD_UID")
    return f"{pod}_{uid}" if pod and uid else f"{socket.gethostname()}_{os.getpid()}_{secrets.token_hex(4)}"


class Leadership:
    """Seeks the Lease, holds it and gives it back."""

    def __init__(self, client: Client, key: LeaseKey, measures: Measures) -> None:
        """`client`: for the Lease alone."""
        self._client = client
        self._key = key
        self._measures = measures
        self._candidate = LeaseCandidate(own_identity(), DURATION, DEADLINE)
        self._changed = asyncio.Event()
        self._logged = ""
        self._was_active = False
        self._namespace_goes = False
        self._released = False
        self._looking = asyncio.Lock()  # so that no renewal is under way when the Lease is released

    def remaining(self) -> float:
        """For how many seconds this manager may act; none or less: it is not the active one."""
        return self._candidate.remaining(steady())

    @property
    def active(self) -> bool:
        """Whether this manager is the active one."""
        return self.remaining() > 0

    @property
    def lease(self) -> TemplateManager | None:
        """The Lease, and when it was created, as statuses of templates have it; None while it was not seen."""
        created = self._candidate.created
        return TemplateManager(lease=str(self._key), since=created) if created else None

    @property
    def role(self) -> str:
        """What this manager is, in words; empty for the active one."""
        if self.active:
            return ""
        return f"standby: {self._candidate.holder or 'nobody'} is active"

    async def look(self) -> None:
        """Read the Lease and take or renew it if it is ours to have. Raises ApiError or Unreachable."""
        async with self._looking:
            if not self._released:
                await self._look()

    async def _look(self) -> None:
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
                self._namespace_goes = True
                self._log(logging.INFO, f"the namespace of the Lease {self._key} does not exist, or is being deleted")
                return
            if error.code not in (404, 409):
                raise
            # Somebody else was first, or has removed it.
            candidate.observe(await self._client.get(LEASES, self._key.namespace, self._key.name), steady())
        self._note_role()

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            await retry_async(self.look, RequestError, self._failed)
            await asyncio.sleep(RENEW_EVERY if self.active else LOOK_EVERY)

    def _failed(self, error: RequestError) -> float:
        left = self.remaining()
        until = f"; active for {left:.0f} s more" if left > 0 else ""
        self._log(logging.WARNING, f"cannot renew the Lease {self._key}{until}: {error}", str(type(error)))
        return LOOK_EVERY

    async def wait_active(self) -> None:
        """Wait until this manager is the active one."""
        while not self.active:
            self._changed.clear()
            await self._changed.wait()

    async def wait_over(self) -> None:
        """Wait until this manager is not the active one any more."""
        while (left := self.remaining()) > 0:
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), left)
            except TimeoutError:
                continue
        self._note_role()

    async def release(self) -> None:
        """Give the Lease back, so that a standby takes it at once. Nothing may be written any more when this is called.

        Where that fails the standby waits until it has seen the Lease unchanged for its duration.
        """
        self._released = True  # not to be taken again
        try:
            async with asyncio.timeout(RENEWAL_TIMEOUT), self._looking:
                draft = self._candidate.released(time.time()) if self.active else None
                self._candidate.until = 0.0
                if draft is None:
                    return
                await self._client.replace(LEASES, draft)
        except (ApiError, Unreachable, TimeoutError) as error:
            gone = isinstance(error, ApiError) and error.code in (404, 409)
            level = logging.INFO if gone else logging.WARNING  # gone with its namespace, or taken
            why = str(error) or "the API server does not respond"
            log.log(level, "cannot release the Lease %s; a standby takes over when it expires: %s", self._key, why)
        else:
            log.info("released the Lease %s", self._key)

    def _note_role(self) -> None:
        """Log the role, once for each change."""
        active, was_active = self.active, self._was_active
        self._was_active = active
        self._measures.active(active)
        if active:
            self._namespace_goes = False
            self._log(logging.INFO, f"active: holds the Lease {self._key} as {self._candidate.identity}")
        elif was_active:
            why = f"the Lease {self._key} was not renewed within {DEADLINE:g} s, or another manager has acquired it"
            self._log(logging.INFO if self._namespace_goes else logging.WARNING, f"no longer active: {why}")
        else:
            self._log(logging.INFO, f"{self.role}, by the Lease {self._key}")
        self._changed.set()

    def _log(self, level: int, message: str, about: str = "") -> None:
        if self._logged != (about or message):
            self._logged = about or message
            log.log(level, "%s", message)
