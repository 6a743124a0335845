"""Ends a manager that has stalled, so that Kubernetes starts it again and a standby takes over meanwhile.

A thread of its own looks, since an event loop that hangs cannot look at itself. It counts its own steps and not the
clock: a process that was stopped as a whole (a stopped container, a sleeping machine) has not stalled.
"""

from __future__ import annotations

import asyncio
import faulthandler
import os
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

SILENT = 30.0
"""Seconds without a sign of life of the event loop after which it hangs, at the most."""

PERSISTENT = 10.0
"""Seconds for which a stall must be seen, so that a process that was stopped has time to continue."""

STALLED = 70
"""The exit code of a manager that was ended: EX_SOFTWARE."""

_STEP = 1.0  # s

Stall = Callable[[], str | None]
"""What has stalled, in words; None where nothing has. Another thread calls it, so it must only read."""


def end_process(reason: str) -> None:
    """End the process at once, and log the reason and where every thread is. It takes no lock: its holder may hang."""
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    line = f"{when},000 CRITICAL watchdog: {reason}; ending this manager, to be restarted\n"
    os.write(2, line.encode())
    faulthandler.dump_traceback(2, all_threads=True)
    os._exit(STALLED)


@asynccontextmanager
async def watchdog(
    stalled: Stall, silent: float = SILENT, *, step: float = _STEP, end: Callable[[str], None] = end_process
) -> AsyncIterator[None]:
    """Look after the event loop that this is entered in, and after what `stalled` reports, while the block runs.

    `silent`: seconds after which an event loop without a sign of life hangs; `step`: seconds between two looks; `end`
    ends the process.
    """
    beats, over = [0], threading.Event()

    def look() -> None:
        seen, quiet, stall = -1, 0.0, 0.0
        while not over.wait(step):
            quiet = quiet + step if beats[0] == seen else 0.0
            seen = beats[0]
            reason = stalled()
            stall = stall + step if reason is not None else 0.0
            if quiet >= silent:
                end(f"the event loop has not run for {quiet:.0f} s")
                return
            if reason is not None and stall >= PERSISTENT:
                end(reason)
                return

    async def beat() -> None:
        while True:
            beats[0] += 1
            await asyncio.sleep(step / 4)

    thread = threading.Thread(target=look, name="watchdog", daemon=True)
    beating = asyncio.create_task(beat(), name="heartbeat")
    thread.start()
    try:
        yield
    finally:
        over.set()
        beating.cancel()
