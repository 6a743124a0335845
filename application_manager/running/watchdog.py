"""Ends a manager that has stalled, so that Kubernetes restarts it and a standby takes over.

It runs in its own thread, because an event loop that hangs cannot check itself. It counts its own steps instead of
reading the clock: a process that was stopped as a whole (a paused container, a sleeping machine) has not stalled.
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
"""The maximum number of seconds without a sign of life of the event loop before it counts as hanging."""

PERSISTENT = 10.0
"""Seconds for which a stall must last, so that a process that was stopped has time to continue."""

STALLED = 70
"""The exit code after a stall: EX_SOFTWARE."""

_STEP = 1.0  # s

Stall = Callable[[], str | None]
"""Reports the stalled part, as text; None: nothing has stalled. Another thread calls it, so it must only read."""


def end_process(reason: str) -> None:
    """End the process immediately, and log the reason and the stacks of all threads.

    It takes no lock: the thread that has it may hang.
    """
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    line = f"{when},000 CRITICAL watchdog: {reason}; ending this manager so that it is restarted\n"
    os.write(2, line.encode())
    faulthandler.dump_traceback(2, all_threads=True)
    os._exit(STALLED)


@asynccontextmanager
async def watchdog(
    stalled: Stall, silent: float = SILENT, *, step: float = _STEP, end: Callable[[str], None] = end_process
) -> AsyncIterator[None]:
    """Supervise the current event loop, and the work that `stalled` reports on, while the block runs.

    `silent`: the maximum seconds without a sign of life of the event loop; `step`: seconds between two checks; `end`
    ends the process.
    """
    beats, over = [0], threading.Event()

    def supervise() -> None:
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

    thread = threading.Thread(target=supervise, name="watchdog", daemon=True)
    beating = asyncio.create_task(beat(), name="heartbeat")
    thread.start()
    try:
        yield
    finally:
        over.set()
        beating.cancel()
