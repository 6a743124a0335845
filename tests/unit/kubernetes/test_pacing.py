"""Namespaces take turns, and one has as many writes under way as the API server answers without a queue."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest

from tests.patience import PATIENCE
from wayside.kubernetes.pacing import CongestionWindow, Pacing

QUICK = 0.004  # s that a write takes at an idle API server
PERIOD = 300.0  # s for which the quickest time is remembered, at least


def served(share: CongestionWindow, cores: float, others: float, writes: int, began: float = 0.0) -> list[int]:
    """The rooms over time, at a server that works on all requests at once: ours, and those of others."""
    rooms: list[int] = []
    for index in range(writes):
        share.note(QUICK * max(1.0, (share.room + others) / cores), began + index * QUICK)
        rooms.append(share.room)
    return rooms


def test_the_share_grows_at_a_server_that_answers_as_quickly_and_shrinks_at_a_busy_one() -> None:
    share = CongestionWindow()
    assert served(share, cores=32, others=0, writes=500)[-1] == 8
    assert served(share, cores=2, others=16, writes=500)[-1] == 1
    assert served(share, cores=32, others=0, writes=500)[-1] == 8


def test_the_share_stays_where_few_requests_wait() -> None:
    share = CongestionWindow()
    served(share, cores=3, others=0, writes=500)
    assert set(served(share, cores=3, others=0, writes=500)) == {4}


def test_a_permanently_slower_server_becomes_the_new_baseline() -> None:
    share = CongestionWindow()
    served(share, cores=2, others=0, writes=100)
    assert served(share, cores=2, others=16, writes=100, began=PERIOD)[-1] == 1
    for period in (2, 4):
        served(share, cores=2, others=16, writes=100, began=period * (PERIOD + 1))
    assert share.room > 1


def test_namespaces_take_turns_and_none_has_more_than_its_share() -> None:
    async def scenario() -> list[str]:
        share = CongestionWindow()
        share.room = 2
        pacing, began, over = Pacing(4, share), list[str](), asyncio.Event()

        async def one(namespace: str) -> None:
            async with pacing.turn(namespace):
                began.append(namespace)
                await over.wait()

        loud = [asyncio.create_task(one("loud")) for _ in range(20)]
        await asyncio.sleep(0)
        others = [asyncio.create_task(one(each)) for each in ("quiet", "")]  # a write, and what is none
        while len(began) < 4:  # noqa: ASYNC110  until all places are taken
            await asyncio.sleep(0)
        over.set()
        await asyncio.gather(*loud, *others)
        return began

    began = asyncio.run(scenario())
    assert began[:4] == ["loud", "loud", "quiet", ""]
    assert len(began) == 22


@pytest.mark.parametrize("waits", [True, False])
def test_a_cancelled_request_leaves_its_place_to_the_next(waits: bool) -> None:
    async def scenario() -> None:
        pacing = Pacing(1, CongestionWindow())

        async def hang(began: asyncio.Event) -> None:
            async with pacing.turn("a"):
                began.set()
                await asyncio.Event().wait()

        first, second = asyncio.Event(), asyncio.Event()
        tasks = [asyncio.create_task(hang(each)) for each in (first, second)]
        await first.wait()
        tasks[1 if waits else 0].cancel()
        if not waits:
            await second.wait()
        for each in tasks:
            each.cancel()
            with suppress(asyncio.CancelledError):
                await each
        async with asyncio.timeout(PATIENCE), pacing.turn("a"):
            pass

    asyncio.run(scenario())
