"""A name is never in two hands, and a change while it is worked on is not missed."""

from __future__ import annotations

import asyncio

from detector.actions.deploy.queue import WorkQueue
from wayside.backoff import Backoff


def test_names_come_in_order_and_once() -> None:
    async def drive() -> list[str]:
        queue = WorkQueue()
        for name in ("b", "a", "b"):
            queue.add(name)
        return [await queue.take(), await queue.take()]

    assert asyncio.run(drive()) == ["b", "a"]


def test_a_name_added_while_it_is_worked_on_comes_again_only_afterwards() -> None:
    async def drive() -> None:
        queue = WorkQueue()
        queue.add("a")
        assert await queue.take() == "a"
        queue.add("a")
        queue.add("b")
        assert await queue.take() == "b"
        waiting = asyncio.create_task(queue.take())
        await asyncio.sleep(0)
        assert not waiting.done(), "a is in somebody's hands"
        queue.done("a")
        assert await waiting == "a"

    asyncio.run(drive())


def test_it_is_empty_only_when_all_work_is_done() -> None:
    async def drive() -> None:
        queue = WorkQueue()
        await queue.empty()
        queue.add("a")
        emptied = asyncio.create_task(queue.empty())
        name = await queue.take()
        await asyncio.sleep(0)
        assert not emptied.done()
        queue.done(name)
        await emptied

    asyncio.run(drive())


def test_delays_double_up_to_the_cap_and_start_over_after_a_success() -> None:
    backoff = Backoff(first=1.0, cap=5.0)
    for most in (1.0, 2.0, 4.0, 5.0, 5.0):
        assert most / 2 <= backoff.fail() <= most
    for _ in range(5000):
        assert backoff.fail() <= 5.0
    backoff.succeed()
    assert backoff.fail() <= 1.0


def test_a_wait_that_the_other_side_asks_for_is_heeded_up_to_the_cap() -> None:
    assert Backoff(first=0.1, cap=5.0).fail(at_least=3.0) == 3.0
    assert Backoff(first=0.1, cap=5.0).fail(at_least=600.0) == 5.0
