"""The manager's memory headroom, which determines whether it accepts more tasks.

Beyond its memory limit, the kernel kills the process, and with it the work for all namespaces. So above 85 % of the
limit, tasks that were never served are not accepted: their statuses give the reason, and a resync accepts them once
memory is free.
"""

from __future__ import annotations

import ctypes
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from application_manager.measures import gauge

_FULL, _ROOM = 0.85, 0.75  # of the limit: memory is short above the first, until it is below the second
_REFRESH_EVERY = 0.5  # s
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
_UNLIMITED = 1 << 60  # bytes: cgroups v1 has this instead of `max`

log = logging.getLogger(__name__)


def container_limit() -> int | None:
    """The memory limit of the container, in bytes; None if there is none."""
    for each in _LIMITS:
        try:
            found = each.read_text().strip()
        except OSError:
            continue
        return int(found) if found.isdigit() and int(found) < _UNLIMITED else None
    return None


class Headroom(Collector):
    """Compares the resident memory of the manager and its worker processes with the limit; also as metrics."""

    def __init__(self, limit: int | None) -> None:
        """`limit`: bytes; None: memory is never short."""
        self.limit = limit
        self._tight = False
        self._refreshed = 0.0  # on the monotonic clock

    def tight(self) -> bool:
        """Whether memory is short, so that no new tasks are accepted."""
        now = time.monotonic()
        if self.limit is not None and now - self._refreshed > _REFRESH_EVERY:
            self._refreshed = now
            self._refresh(self.limit)
        return self._tight

    def collect(self) -> Iterator[Metric]:
        """The current metrics."""
        what = "of the manager and its worker processes"
        yield gauge("memory_bytes", f"Resident memory {what}", _resident())
        yield gauge("memory_tight", "1 while memory is short and no new tasks are accepted", self.tight())
        if self.limit is not None:
            yield gauge("memory_limit_bytes", f"Memory limit {what}", self.limit)

    def _refresh(self, limit: int) -> None:
        used = _resident()
        if used > _ROOM * limit:
            _return_free_memory()
            used = _resident()
        tight = used > (_ROOM if self._tight else _FULL) * limit
        if tight != self._tight:
            what = "not accepting new tasks" if tight else "accepting new tasks again"
            log.warning("using %d of %d MiB of memory: %s", used >> 20, limit >> 20, what)
        self._tight = tight


def _resident() -> int:
    """Resident bytes of this process and its children; shared memory counts for each of them."""
    children = Path(f"/proc/self/task/{os.getpid()}/children")
    try:
        pids = ["self", *children.read_text().split()]
    except OSError:  # a kernel without this list
        pids = ["self"]
    return sum(map(_resident_of, pids))


def _resident_of(pid: str) -> int:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # it has just ended
        return 0


def _return_free_memory() -> None:
    """Return free memory to the kernel: memory that the allocator keeps counts as used."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only
    if trim is not None:
        trim(0)
