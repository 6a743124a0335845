"""The watchdog ends a manager of which any part hangs, but not one that works or was suspended."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading

import pytest

from application_manager.measures import Measures
from application_manager.observability.pages import stalled
from application_manager.running import watchdog
from application_manager.running.watchdog import STALLED
from tests.patience import PATIENCE
from wayside.kubernetes.workqueue import WorkQueue


def ended_by(stall: watchdog.Stall, *, hangs: bool = False, silent: float = 3600.0) -> str | None:
    """The reason for which the watchdog ends a loop that `hangs`, if it does."""
    logged: list[str] = []
    called = threading.Event()

    def end(reason: str) -> None:
        logged.append(reason)
        called.set()

    async def scenario() -> None:
        async with watchdog.watchdog(stall, silent, step=0.02, end=end):
            if hangs:
                called.wait(PATIENCE)
            await asyncio.to_thread(called.wait, PATIENCE if hangs or stall() else 0.3)

    asyncio.run(scenario())
    return logged[0] if logged else None


def test_an_event_loop_that_hangs_is_ended() -> None:
    assert "the event loop has not run for" in str(ended_by(lambda: None, hangs=True, silent=0.2))


def test_a_stall_that_persists_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "PERSISTENT", 0.2)
    assert ended_by(lambda: "no resync has completed for 300 s") == "no resync has completed for 300 s"


def test_a_working_manager_is_left_alone() -> None:
    assert ended_by(lambda: None) is None


def test_the_process_ends_with_a_log_line_and_the_stack_trace() -> None:
    program = """
import asyncio, time
from application_manager.running.watchdog import watchdog
def hanging(): time.sleep(600)
async def main():
    async with watchdog(lambda: None, 2.0, step=0.05):
        await asyncio.sleep(0.1)
        hanging()
asyncio.run(main())
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == STALLED
    assert "CRITICAL watchdog: the event loop has not run for" in done.stderr
    assert "in hanging" in done.stderr


def test_a_worker_that_exceeds_its_time_for_a_key_has_stalled() -> None:
    async def scenario() -> tuple[str | None, str | None, str | None]:
        begun = asyncio.Event()

        async def work(_: str) -> None:
            begun.set()
            await asyncio.sleep(3600)

        queue = WorkQueue("instance", work, 1)
        look = stalled(Measures(), 0.01, [queue], least=0.05)
        before = queue.stuck(0.05)
        queue.add("north")
        running = asyncio.create_task(queue.run())
        await begun.wait()
        await asyncio.sleep(0.1)
        found = look()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        return before, found, stalled(Measures(), 3600, [queue])()

    before, found, after = asyncio.run(scenario())
    assert before is None
    assert "instance north has been in progress for" in str(found)
    assert after is None
