"""The reconciler makes the tasks equal to the demands, here in a folder instead of the API server."""

from __future__ import annotations

import asyncio
import dataclasses
import tempfile
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.actions.deploy.file_store import FileTaskStore, write_tasks_yaml
from detector.actions.deploy.reconciler import DemandReconciler, DeployCounts
from detector.actions.deploy.stores import restore, task_manifest
from detector.engine.episodes.demands import Demand, to_task
from tests.patience import PATIENCE
from tests.unit.actions.test_demands import DEMAND, changed
from wayside.api.documents import load_documents
from wayside.times import format_time

HOLDER = DEMAND.holder
NEVER = 3600.0  # seconds between two looks at the folder: what is there is found only by stumbling over it


def demand(subject: str, **changes: Any) -> Demand:
    return changed(subject=subject, clients=tuple(subject.split("+")), **changes)


A, B, C = demand("a+b"), demand("c+d"), demand("e+f")


def by_name(*demands: Demand) -> dict[str, Demand]:
    return {each.name: each for each in demands}


@asynccontextmanager
async def reconciling(folder: Path, interval: float = 0.02, **options: Any) -> AsyncIterator[DemandReconciler]:
    reconciler = DemandReconciler(FileTaskStore(folder, HOLDER, interval), **options)
    running = asyncio.create_task(reconciler.run())
    yield reconciler
    reconciler.stop(deadline=PATIENCE)
    await running


async def eventually(holds: Callable[[], bool], what: str) -> None:
    try:
        async with asyncio.timeout(PATIENCE):
            while not holds():  # noqa: ASYNC110  files do not notify of changes
                await asyncio.sleep(0.005)
    except TimeoutError:
        raise AssertionError(f"still not: {what}") from None


def stored(folder: Path) -> dict[str, dict[str, Any]]:
    """The existing tasks; a file removed while the folder is read is skipped."""
    tasks = {}
    for file in sorted(folder.glob("[!.]*.yaml")):
        with suppress(FileNotFoundError):
            tasks[file.stem] = yaml.safe_load(file.read_text())
    return tasks


def ends(folder: Path) -> dict[str, str | None]:
    return {name: task["spec"].get("endTime") for name, task in stored(folder).items()}


def put(folder: Path, task: Mapping[str, Any]) -> Path:
    """Write the file atomically: readers see all of it or nothing."""
    file = folder / f"{task['metadata']['name']}.yaml"
    unfinished = folder / ".unfinished"
    unfinished.write_text(yaml.safe_dump(dict(task)))
    return unfinished.replace(file)


def test_a_demand_is_a_task_from_its_start_to_its_end(tmp_path: Path) -> None:
    async def drive() -> DeployCounts:
        async with reconciling(tmp_path) as reconciler:
            reconciler.update(by_name(A, B), {})
            await eventually(lambda: ends(tmp_path) == {A.name: None, B.name: None}, "both live")
            assert await restore(FileTaskStore(tmp_path, HOLDER)) == sorted([A, B], key=lambda each: each.name)
            reconciler.update(by_name(B), {A.name: A.episode.start_time + 5})
            await eventually(lambda: ends(tmp_path)[A.name] is not None, "the first has ended")
        return reconciler.counts

    assert asyncio.run(drive()) == DeployCounts(created=2, ended=1)
    assert ends(tmp_path) == {A.name: format_time(A.episode.start_time + 5), B.name: None}
    assert stored(tmp_path)[B.name]["metadata"]["creationTimestamp"] == "2026-01-01T00:00:02Z"


def test_due_changes_are_written_before_the_reconciler_stops(tmp_path: Path) -> None:
    async def drive() -> None:
        async with reconciling(tmp_path) as reconciler:
            reconciler.update(by_name(A), {})
            await eventually(lambda: A.name in ends(tmp_path), "it is live")
            reconciler.update(by_name(B), {A.name: 7})

    asyncio.run(drive())
    assert ends(tmp_path) == {A.name: format_time(7), B.name: None}


def test_a_demand_without_a_reported_end_ends_now(tmp_path: Path) -> None:
    async def drive() -> None:
        async with reconciling(tmp_path, now=lambda: 42) as reconciler:
            reconciler.update(by_name(A), {})
            await eventually(lambda: A.name in ends(tmp_path), "it is live")
            reconciler.update({}, {})

    asyncio.run(drive())
    assert ends(tmp_path) == {A.name: format_time(42)}


def test_no_task_is_ended_before_the_first_demands_of_the_engine(tmp_path: Path) -> None:
    put(tmp_path, task_manifest(to_task(A)))
    before = stored(tmp_path)

    async def drive() -> None:
        async with reconciling(tmp_path) as reconciler:
            earlier = reconciler.snapshots
            await eventually(lambda: reconciler.snapshots > earlier + 3, "it has looked")
            assert stored(tmp_path) == before
            reconciler.update({}, {})
            await eventually(lambda: ends(tmp_path)[A.name] is not None, "it has ended")

    asyncio.run(drive())


def test_nothing_is_changed_without_permission(tmp_path: Path) -> None:
    async def drive() -> None:
        permitted = asyncio.Event()
        async with reconciling(tmp_path, permitted=permitted) as reconciler:
            reconciler.update(by_name(A), {})
            await eventually(lambda: reconciler.snapshots > 3, "it has looked")
            assert ends(tmp_path) == {}
            permitted.set()
            await eventually(lambda: A.name in ends(tmp_path), "it is live")

    asyncio.run(drive())


def test_an_existing_task_of_the_same_name_is_adopted_and_updated(tmp_path: Path) -> None:
    async def drive() -> DeployCounts:
        async with reconciling(tmp_path, NEVER) as reconciler:
            await eventually(lambda: reconciler.snapshots > 0, "it has looked")
            put(tmp_path, task_manifest(to_task(dataclasses.replace(A, parameters={"old": 1}))))
            reconciler.update(by_name(A), {})
            await eventually(lambda: stored(tmp_path)[A.name]["spec"]["parameters"] == A.parameters, "it is put right")
        return reconciler.counts

    assert asyncio.run(drive()) == DeployCounts(adopted=1, patched=1)


def test_a_task_of_another_holder_with_the_same_name_is_left_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    foreign = task_manifest(to_task(A))
    foreign["spec"]["requester"]["holder"] = "somebody-else"
    file = put(tmp_path, foreign)
    text = file.read_text()

    async def drive() -> DeployCounts:
        async with reconciling(tmp_path) as reconciler:
            reconciler.update(by_name(A, B), {})
            await eventually(lambda: reconciler.counts.refused["AlreadyExists"] > 2, "it was refused again and again")
            await eventually(lambda: B.name in ends(tmp_path), "the other demand is served")
            reconciler.update({}, {A.name: 1, B.name: 2})
        return reconciler.counts

    assert asyncio.run(drive()).created == 1
    assert file.read_text() == text
    assert caplog.text.count("belongs to another holder") == 1, "logged once, then only counted"


def test_a_manually_deleted_task_is_recreated_and_a_manually_ended_one_stays_ended(tmp_path: Path) -> None:
    async def drive() -> DeployCounts:
        async with reconciling(tmp_path) as reconciler:
            reconciler.update(by_name(A, B), {})
            await eventually(lambda: len(ends(tmp_path)) == 2, "both live")
            earlier = reconciler.snapshots
            await eventually(lambda: reconciler.snapshots > earlier + 1, "it has seen them live")
            (tmp_path / f"{A.name}.yaml").unlink()
            put(tmp_path, task_manifest(to_task(B, end_time=3)))
            await eventually(lambda: A.name in ends(tmp_path), "it is back")
            earlier = reconciler.snapshots
            await eventually(lambda: reconciler.snapshots > earlier + 3, "it has looked")
        return reconciler.counts

    assert asyncio.run(drive()) == DeployCounts(created=2, recreated=1)
    assert ends(tmp_path) == {A.name: None, B.name: format_time(3)}


def test_a_task_that_an_earlier_run_over_the_same_data_ended_is_recreated(tmp_path: Path) -> None:
    put(tmp_path, task_manifest(to_task(A, end_time=3)))

    async def drive() -> DeployCounts:
        async with reconciling(tmp_path) as reconciler:
            reconciler.update(by_name(A), {})
            await eventually(lambda: ends(tmp_path) == {A.name: None}, "it is live")
        return reconciler.counts

    assert asyncio.run(drive()) == DeployCounts(created=1, replaced=1)


def test_an_outage_delays_and_loses_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder, there = tmp_path / "tasks", tmp_path / "there"
    there.mkdir()
    (away := tmp_path / "away").write_text("a file where the folder was: nothing can be read or written")

    def turn(to: Path) -> None:
        """The folder is this one, from one moment to the next."""
        (new := tmp_path / "new").symlink_to(to)
        new.replace(folder)

    async def drive() -> DeployCounts:
        turn(there)
        async with reconciling(folder) as reconciler:
            reconciler.update(by_name(A), {})
            await eventually(lambda: A.name in ends(folder), "it is live")
            turn(away)
            reconciler.update(by_name(B, C), {A.name: 5})
            await eventually(lambda: reconciler.counts.retried > 1, "the outage was met")
            reconciler.update(by_name(B), {C.name: 6})
            retried = reconciler.counts.retried  # with one attempt that may have begun before
            await eventually(lambda: reconciler.counts.retried > retried + 1, "it continues")
            turn(there)
            await eventually(lambda: ends(folder) == {A.name: format_time(5), B.name: None}, "all is made good")
        return reconciler.counts

    assert asyncio.run(drive()).created == 2
    assert caplog.text.count("cannot update tasks; retrying with backoff") == 1


def test_a_demand_without_a_valid_task_is_rejected_and_affects_no_other(tmp_path: Path) -> None:
    async def drive() -> DeployCounts:
        async with reconciling(tmp_path) as reconciler:
            reconciler.update(by_name(demand("x" * 600), A), {})
            await eventually(lambda: A.name in ends(tmp_path), "the other is live")
        return reconciler.counts

    assert asyncio.run(drive()).refused["Invalid"] > 0


MOVES = st.lists(
    st.dictionaries(st.sampled_from(["a+b", "c+d", "e+f"]), st.integers(0, 2), max_size=3), min_size=1, max_size=8
)


@settings(max_examples=25)
@given(MOVES, st.integers(0, 3))
def test_only_the_newest_demands_count(moves: list[dict[str, int]], pauses: int) -> None:
    """Each move is a full set: subjects, and a parameter that may have changed. A demand that ended does not return."""
    sets: list[dict[str, Demand]] = []
    reported: dict[str, int] = {}
    for number, move in enumerate(moves):
        present = {subject: demand(subject, parameters={"level": float(level)}) for subject, level in move.items()}
        gone = {each.name for each in (sets[-1].values() if sets else [])} - {each.name for each in present.values()}
        reported |= {name: number for name in gone if name not in reported}
        sets.append(by_name(*(each for each in present.values() if each.name not in reported)))

    async def drive(folder: Path) -> None:
        async with reconciling(folder) as reconciler:
            for number, demands in enumerate(sets):
                reconciler.update(demands, {name: end for name, end in reported.items() if end <= number})
                for _ in range(pauses):
                    await asyncio.sleep(0.002)
            await eventually(lambda: reconciler.snapshots > 0, "it has looked")

    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(drive(Path(folder)))
        found = stored(Path(folder))
        live = {name: task["spec"]["parameters"] for name, task in found.items() if "endTime" not in task["spec"]}
        assert live == {name: each.parameters for name, each in sets[-1].items()}
        ended = {name: task["spec"]["endTime"] for name, task in found.items() if "endTime" in task["spec"]}
        assert ended == {name: format_time(reported[name]) for name in ended}


def test_tasks_of_a_replay_go_into_one_file_in_the_order_of_their_starts(tmp_path: Path) -> None:
    late = demand("a+b", start_time=A.episode.start_time + 10)
    write_tasks_yaml(tmp_path / "tasks.yaml", [to_task(late), to_task(C, 9), to_task(B)])
    documents = load_documents([tmp_path / "tasks.yaml"])
    assert [each.object.name for each in documents] == [*sorted([B.name, C.name]), late.name]


def test_a_file_without_a_task_is_left_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "notes.yaml").write_text("just: notes")
    (tmp_path / "half.yaml").write_text("kind: [")
    assert asyncio.run(restore(FileTaskStore(tmp_path, HOLDER))) == []
    assert "notes.yaml, which is not an ApplicationTask" in caplog.text
    assert "half.yaml, which is not an ApplicationTask" in caplog.text
