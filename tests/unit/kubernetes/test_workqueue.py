"""The queue works on each key at most once at a time, and again if it was enqueued or failed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager

import pytest

from tests.patience import PATIENCE
from wayside.kubernetes import workqueue
from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.workqueue import WorkQueue


@asynccontextmanager
async def running(*queues: WorkQueue[str]) -> AsyncIterator[None]:
    tasks = [asyncio.create_task(queue.run()) for queue in queues]
    try:
        async with asyncio.timeout(PATIENCE):
            yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def in_a_loop(test: Callable[[], Coroutine[None, None, None]]) -> Callable[[], None]:
    def run() -> None:
        asyncio.run(test())

    run.__name__ = test.__name__
    return run


@in_a_loop
async def test_a_key_requested_while_it_waits_is_worked_on_once() -> None:
    done: list[str] = []
    idle = asyncio.Event()

    async def work(key: str) -> None:
        done.append(key)
        if key == "last":
            idle.set()

    queue = WorkQueue("q", work, 1)
    for key in ("a", "a", "b", "a", "last"):
        queue.add(key)
    async with running(queue):
        await idle.wait()
    assert done == ["a", "b", "last"]


@in_a_loop
async def test_a_key_requested_while_it_runs_is_worked_on_once_more_and_never_twice_at_once() -> None:
    started = 0
    at_once = 0
    once, twice, more = asyncio.Event(), asyncio.Event(), asyncio.Event()

    async def work(key: str) -> None:
        nonlocal started, at_once
        started, at_once = started + 1, at_once + 1
        assert at_once == 1
        (once if started == 1 else twice).set()
        await more.wait()
        at_once -= 1

    queue = WorkQueue("q", work, 4)
    async with running(queue):
        queue.add("a")
        await once.wait()
        queue.add("a")
        queue.add("a")
        more.set()
        await twice.wait()
    assert started == 2


@in_a_loop
async def test_the_queue_is_idle_only_without_waiting_and_running_keys() -> None:
    begun, more = asyncio.Event(), asyncio.Event()

    async def work(key: str) -> None:
        begun.set()
        await more.wait()

    queue = WorkQueue("q", work, 1)
    await queue.idle()
    async with running(queue):
        queue.add("a")
        idle = asyncio.create_task(queue.idle())
        await begun.wait()
        queue.add("b")
        queue.add("a")
        assert (len(queue), idle.done()) == (2, False)
        more.set()
        await idle
        assert len(queue) == 0


@pytest.mark.parametrize("error", [Unreachable("gone"), ApiError(503, "busy"), ValueError("a defect")])
def test_a_failed_key_is_retried_and_blocks_no_other(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workqueue, "FIRST_PAUSE", 0.01)
    done: list[str] = []

    async def scenario() -> None:
        finished = asyncio.Event()

        async def work(key: str) -> None:
            done.append(key)
            if key == "bad" and done.count("bad") < 3:
                raise error
            if key == "bad":
                finished.set()

        queue = WorkQueue("q", work, 1)
        queue.add("bad")
        queue.add("good")
        async with running(queue):
            await finished.wait()

    asyncio.run(scenario())
    assert done == ["bad", "good", "bad", "bad"]


def test_a_retry_after_of_the_api_server_is_honoured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workqueue, "FIRST_PAUSE", 0.01)
    at: list[float] = []

    async def scenario() -> None:
        finished = asyncio.Event()

        async def work(key: str) -> None:
            at.append(time.monotonic())
            if len(at) == 1:
                raise ApiError(429, "too many", retry_after=0.3)
            finished.set()

        queue = WorkQueue("q", work, 1)
        queue.add("a")
        async with running(queue):
            await finished.wait()

    asyncio.run(scenario())
    assert at[1] - at[0] >= 0.29  # the queue goes by another clock


@in_a_loop
async def test_the_earliest_time_requested_counts() -> None:
    done = asyncio.Event()

    async def work(key: str) -> None:
        done.set()

    queue = WorkQueue("q", work, 1)
    async with running(queue):
        queue.add_at("a", time.time() + 100)
        queue.add_at("a", time.time() - 100)
        queue.add_at("a", time.time() + 200)
        await done.wait()


@in_a_loop
async def test_a_subordinate_queue_waits_while_the_other_has_work() -> None:
    done: list[str] = []
    finished = asyncio.Event()

    async def first(key: str) -> None:
        await asyncio.sleep(0.02)
        done.append(key)

    async def second(key: str) -> None:
        done.append(key)
        finished.set()

    before = WorkQueue("first", first, 1)
    after = WorkQueue("second", second, 1, before)
    for key in ("a", "b", "c"):
        before.add(key)
    after.add("words")
    async with running(before, after):
        await finished.wait()
    assert done.index("words") >= 2


@in_a_loop
async def test_a_worker_whose_cancellation_is_masked_by_an_error_still_ends() -> None:
    begun = asyncio.Event()
    times = 0

    async def part() -> None:
        begun.set()
        await asyncio.sleep(0)
        raise Unreachable("gone")

    async def work(_: str) -> None:
        nonlocal times
        times += 1
        try:
            await asyncio.gather(part(), asyncio.sleep(60))
        except asyncio.CancelledError:
            raise Unreachable("gone") from None  # as gather does where a part fails at that very moment

    queue = WorkQueue("q", work, 1)
    queue.add("a")
    queue.add("b")
    running = asyncio.create_task(queue.run())
    await begun.wait()
    running.cancel()
    await asyncio.wait({running}, timeout=PATIENCE)
    assert running.cancelled()
    assert times == 1


def test_namespaces_take_turns() -> None:
    done: list[tuple[str, str]] = []

    async def scenario() -> None:
        finished = asyncio.Event()

        async def work(key: tuple[str, str]) -> None:
            done.append(key)
            if len(done) == 6:
                finished.set()

        queue = WorkQueue("q", work, 1)
        for key in [("a", "1"), ("a", "2"), ("a", "3"), ("a", "4"), ("b", "1"), ("c", "1")]:
            queue.add(key)
        async with running(queue):
            await finished.wait()

    asyncio.run(scenario())
    assert done == [("a", "1"), ("b", "1"), ("c", "1"), ("a", "2"), ("a", "3"), ("a", "4")]


def test_no_namespace_has_more_workers_than_its_share() -> None:
    done: list[tuple[str, str]] = []

    async def scenario() -> None:
        free, served = asyncio.Event(), asyncio.Event()
        at_work = 0

        async def work(key: tuple[str, str]) -> None:
            nonlocal at_work
            if key[0] == "b":
                served.set()
                return
            at_work += 1
            assert at_work == 1
            await free.wait()
            at_work -= 1
            done.append(key)
            if len(done) == 3:
                served.set()

        queue = WorkQueue("q", work, 4, share=1)
        for name in "123":
            queue.add(("a", name))
        queue.add(("b", "1"))
        async with running(queue):
            await served.wait()
            served.clear()
            free.set()
            await served.wait()

    asyncio.run(scenario())
    assert done == [("a", "1"), ("a", "2"), ("a", "3")]


@in_a_loop
async def test_a_subordinate_queue_waits_only_within_the_same_namespace() -> None:
    done: list[tuple[str, str]] = []
    both = asyncio.Event()

    async def report(key: tuple[str, str]) -> None:
        done.append(key)
        if len(done) == 2:
            both.set()

    async def never(_: tuple[str, str]) -> None:
        raise AssertionError

    first = WorkQueue("first", never, 1)
    first.add(("loud", "waits"))
    queue = WorkQueue("q", report, 1, first)
    queue.add(("loud", "a"))
    queue.add(("quiet", "b"))
    working = asyncio.create_task(queue.run())
    async with asyncio.timeout(PATIENCE):
        await both.wait()
    working.cancel()
    assert done == [("quiet", "b"), ("loud", "a")]
