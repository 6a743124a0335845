"""The work of the active manager only: reconciling, posting Events, publishing configurations.

It may start and stop several times: a manager that cannot renew its Lease stops immediately and becomes a standby, and
may become active again. At the end of the process, the current work is finished, within a time limit, and then the
Lease is released.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any, Protocol

from application_manager.cluster.leadership import Leadership
from wayside.kubernetes.client import Client

FINISHING = 3.0
"""Seconds for the current work at the end; the next start repeats the unfinished work."""

_AGAIN = 0.5  # s until a task that does not stop is cancelled again

log = logging.getLogger(__name__)


Begin = Callable[[bool], Awaitable[None]]
"""Prepares to act; True: another manager may have acted since the first lists."""


class ActiveWork(Protocol):
    """Works until it is cancelled, or finished."""

    async def run(self) -> None:
        """Work."""

    def finish(self) -> None:
        """Return after the current work is done."""


async def acting(
    leadership: Leadership,
    client: Client,
    queues: Sequence[ActiveWork],
    reporters: Sequence[ActiveWork],
    begin: Begin,
    stop: asyncio.Event,
) -> None:
    """Act whenever this manager is active, until `stop` is set; then the Lease is released.

    `reporters` report the work of the queues, and therefore end after them; `begin` is called each time before the
    work.
    """
    stopping = asyncio.create_task(stop.wait(), name="stop")
    again = not leadership.active
    try:
        while await run_until_stopped(stop, leadership.wait_active()) and not stop.is_set():
            over = asyncio.create_task(leadership.wait_over(), name="lost")
            work = asyncio.create_task(_work(queues, reporters, begin, again), name="work")
            try:
                await asyncio.wait((work, over, stopping), return_when=asyncio.FIRST_COMPLETED)
                if stopping.done() and not work.done():
                    for queue in queues:
                        queue.finish()
                    await asyncio.wait((work, over), timeout=FINISHING, return_when=asyncio.FIRST_COMPLETED)
            finally:
                await cancel_and_wait(work, over)
            if not work.cancelled():
                work.result()
            again = True
    finally:
        stopping.cancel()
    await _release(leadership, client)


async def _work(queues: Sequence[ActiveWork], reporters: Sequence[ActiveWork], begin: Begin, again: bool) -> None:
    """Act; returns once all queues have finished, and then all reporters."""
    await begin(again)
    working = asyncio.create_task(_run(queues), name="queues")
    reporting = asyncio.create_task(_run(reporters), name="reporters")
    try:
        await asyncio.wait((working, reporting), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            for reporter in reporters:
                reporter.finish()
            await reporting
    finally:
        await cancel_and_wait(working, reporting)
    for task in (working, reporting):
        if not task.cancelled():
            task.result()


async def _run(workers: Sequence[ActiveWork]) -> None:
    async with asyncio.TaskGroup() as group:
        for worker in workers:
            group.create_task(worker.run())


async def cancel_and_wait(*tasks: asyncio.Task[Any]) -> None:
    """Cancel the tasks and wait until they have ended.

    The cancellation is repeated, because an error of another part of a `gather` may swallow it.
    """
    pending = {each for each in tasks if not each.done()}
    while pending:
        for task in pending:
            task.cancel()
        _, pending = await asyncio.wait(pending, timeout=_AGAIN)


async def run_until_stopped(stop: asyncio.Event, work: Coroutine[None, None, None]) -> bool:
    """Do the work, and cancel it when `stop` is set; returns whether it was done. Raises the exceptions of the work."""
    working, stopping = asyncio.create_task(work), asyncio.create_task(stop.wait())
    try:
        await asyncio.wait((working, stopping), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            working.result()
        return working.done()
    finally:
        await cancel_and_wait(working, stopping)


async def _release(leadership: Leadership, client: Client) -> None:
    """Release the Lease, unless a request that was given up may still take effect: then the Lease expires by itself."""
    if not leadership.active:
        return
    if client.open_until > time.monotonic():
        log.warning("requests are still in progress: not releasing the Lease; a standby takes over when it expires")
        return
    await leadership.release()
