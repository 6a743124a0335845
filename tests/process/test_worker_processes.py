"""Users' expressions run in worker processes: a slow one is ended there and affects no other."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from application_manager.measures import Measures
from application_manager.workers.answers import AnswerCache, Exceeded
from application_manager.workers.pool import ExceededError, JobError, Pool
from tests.worker_jobs import Defective, Evaluation, Greedy, KilledOnce, Scheduled, Where

LIMIT = 0.5
"""The limit in seconds of CPU time; jobs that must not exceed it take a fiftieth of it."""

BOMB = Evaluation(100_000)


def with_pool(work: Callable[[Pool], Awaitable[None]], cpu_time: float = LIMIT) -> None:
    async def run() -> None:
        pool = Pool(Measures(), cpu_time)
        try:
            await work(pool)
        finally:
            await pool.close()

    asyncio.run(run())


def alive(pid: int) -> bool:
    """Whether the process exists."""
    return Path(f"/proc/{pid}").exists()


def test_a_job_that_exceeds_its_cpu_time_is_killed_and_its_worker_replaced() -> None:
    async def work(pool: Pool) -> None:
        before = await pool.run("a", Where())
        with pytest.raises(ExceededError, match=r"took more than 0\.5 s of CPU time and was stopped"):
            await pool.run("a", BOMB)
        after = await pool.run("a", Where())
        assert after != before
        assert await pool.run("a", Evaluation(1)) == 0
        assert await pool.run("a", Where()) == after

    with_pool(work)


def test_the_event_loop_continues_while_an_expression_holds_the_gil() -> None:
    async def work(pool: Pool) -> None:
        bomb = asyncio.create_task(pool.run("a", BOMB))
        turns = 0
        while not bomb.done():
            turns += 1
            await asyncio.sleep(0.01)
        assert turns > 3  # with the GIL held there would be one
        with pytest.raises(ExceededError):
            await bomb

    with_pool(work)


def test_a_namespace_of_expensive_expressions_leaves_a_worker_to_the_others() -> None:
    async def work(pool: Pool) -> None:
        bombs = [asyncio.create_task(pool.run("a", BOMB)) for _ in range(6)]
        others = [await pool.run(namespace, Where()) for namespace in "bcdbcd"]
        assert len(set(others)) == 1
        assert not bombs[-1].done()
        for bomb in bombs:
            bomb.cancel()
        await asyncio.gather(*bombs, return_exceptions=True)

    with_pool(work)


def test_a_process_runs_only_while_nothing_else_in_the_container_wants_the_cpu() -> None:
    async def work(pool: Pool) -> None:
        assert await pool.run("a", Scheduled()) == os.SCHED_IDLE

    with_pool(work)


def test_there_are_never_more_than_two_processes() -> None:
    async def work(pool: Pool) -> None:
        places = await asyncio.gather(*(pool.run(str(index % 7), Where()) for index in range(50)))
        assert len(set(places)) <= 2

    with_pool(work)


def test_a_job_whose_worker_is_killed_is_retried_in_another(tmp_path: Path) -> None:
    async def work(pool: Pool) -> None:
        assert await pool.run("a", KilledOnce(tmp_path / "killed")) == "done"

    with_pool(work)


def test_a_job_that_exceeds_its_memory_is_killed_too() -> None:
    async def work(pool: Pool) -> None:
        with pytest.raises(ExceededError, match="was stopped, since its process was ended by SIGABRT"):
            await pool.run("a", Greedy())
        assert await pool.run("a", Evaluation(1)) == 0

    with_pool(work)


def test_an_exception_in_a_job_fails_only_that_job() -> None:
    async def work(pool: Pool) -> None:
        with pytest.raises(JobError, match="RuntimeError: a defect"):
            await pool.run("a", Defective())
        assert await pool.run("a", Evaluation(1)) == 0

    with_pool(work)


def test_at_shutdown_busy_workers_end_too() -> None:
    async def work(pool: Pool) -> None:
        pid = await pool.run("a", Where())
        bomb = asyncio.create_task(pool.run("a", BOMB))
        await asyncio.sleep(0)
        await pool.close()
        with pytest.raises(asyncio.CancelledError):
            await bomb
        assert not alive(pid)

    with_pool(work, cpu_time=600.0)


def test_answers_are_cached_and_a_timeout_is_not_computed_again() -> None:
    async def work(pool: Pool) -> None:
        answers = AnswerCache(pool)
        done = asyncio.Event()

        async def answer(question: object, job: Evaluation | Where) -> object:
            done.clear()
            found = answers.answer("key", question, "a", lambda: job, done.set)
            if found is None:
                await done.wait()
                found = answers.answer("key", question, "a", Defective, done.set)
            return found

        first = await answer(1, Where())
        assert await answer(1, Defective()) == first  # type: ignore[arg-type]  it is not read
        exceeded = await answer(2, BOMB)
        assert isinstance(exceeded, Exceeded)
        assert await answer(2, Where()) == exceeded
        assert await answer(3, Evaluation(1)) == 0
        await answers.close()

    with_pool(work)


def test_the_answer_cache_evicts_least_recently_used_answers() -> None:
    async def work(pool: Pool) -> None:
        answers, done = AnswerCache(pool, kept=40), asyncio.Event()

        async def answer(key: str) -> object:
            done.clear()
            if answers.answer(key, 1, "a", Where, done.set) is None:
                await done.wait()
            return answers.answer(key, 1, "a", Where, done.set)

        assert await answer("first") is not None
        for index in range(20):
            assert await answer(f"later {index}") is not None
        assert answers.answer("first", 1, "a", Where, done.set) is None
        await answers.close()

    with_pool(work)
