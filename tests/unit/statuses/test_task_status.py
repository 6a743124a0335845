"""The status and the metrics show what the deploy actions did to tasks, and the Lease of the holder."""

from __future__ import annotations

import asyncio
import io
from pathlib import Path

import msgspec
from rich.console import Console, RenderableType

from detector.actions.deploy.file_store import FileTaskStore
from detector.actions.deploy.lease import HolderLease, ProcessIdentity
from detector.actions.deploy.reconciler import DemandReconciler
from detector.live.answers import lease_status, reconciler_status
from detector.status.model import LeaseStatus, Status, TaskStatus, read_status, to_json
from detector.status.table import status_view, total_view
from detector.status.total import total
from tests.driving import Drive, a_detector
from tests.unit.actions.test_deploy import HOLDER, A, B, by_name, ends, eventually, reconciling
from tests.unit.statuses.test_metrics import samples
from tests.unit.statuses.test_status import ObservedEngine
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import Unreachable

CHANGED = TaskStatus(created=2, recreated=1, retried=4, refused={"Forbidden": 3, "Invalid": 1}, pending=1)


def shown(view: RenderableType) -> list[str]:
    console = Console(width=200, file=io.StringIO(), record=True)
    console.print(view)
    return [line.strip() for line in console.export_text().splitlines()]


def a_status(tasks: TaskStatus, lease: LeaseStatus | None = None) -> Status:
    status = ObservedEngine(Drive(a_detector())).take(until=1)
    return msgspec.structs.replace(status, tasks=tasks, lease=lease)


def test_the_status_has_the_counts_of_the_reconciler(tmp_path: Path) -> None:
    async def drive() -> DemandReconciler:
        async with reconciling(tmp_path) as reconciler:
            reconciler.update(by_name(A, B), {})
            await eventually(lambda: len(ends(tmp_path)) == 2, "both exist")
            reconciler.update(by_name(B), {A.name: A.episode.start_time + 5})
            await eventually(lambda: ends(tmp_path)[A.name] is not None, "the first has ended")
        return reconciler

    assert reconciler_status(asyncio.run(drive())) == TaskStatus(created=2, ended=1)


def test_tasks_that_wait_for_a_change_are_pending_and_refusals_have_reasons(tmp_path: Path) -> None:
    async def drive() -> TaskStatus:
        reconciler = DemandReconciler(FileTaskStore(tmp_path, HOLDER), permitted=asyncio.Event())
        running = asyncio.create_task(reconciler.run())
        reconciler.update(by_name(A, B), {})
        await eventually(lambda: reconciler.pending == 2, "both wait for the Lease")
        reconciler.counts.refused["Forbidden"] += 1
        status = reconciler_status(reconciler)
        reconciler.stop()
        await running
        return status

    assert asyncio.run(drive()) == TaskStatus(pending=2, refused={"Forbidden": 1})


def test_the_status_counts_failed_renewals_of_the_lease() -> None:
    class NoServer:
        async def get(self, *_: object) -> None:
            raise Unreachable("no route to host")

    async def drive() -> LeaseStatus:
        client: Client = NoServer()  # type: ignore[assignment]
        lease = HolderLease(client, "driving", HOLDER, ProcessIdentity("pod-1"), duration=3.0)
        running = asyncio.create_task(lease.run())
        await eventually(lambda: lease.failures > 0, "an attempt has failed")
        lease.stop()
        await running
        return lease_status(lease)

    status = asyncio.run(drive())
    assert not status.held
    assert status.attempts == status.failures > 0


def test_the_tables_show_tasks_and_lease() -> None:
    status = a_status(CHANGED, LeaseStatus(held=True, attempts=30, failures=2))
    assert read_status(to_json(status)) == status
    lines = shown(status_view(status))
    assert "tasks: 2 created, 1 recreated, 4 retried, 1 pending" in lines
    assert "tasks refused: 3 Forbidden, 1 Invalid" in lines
    assert "Lease held; 2 of 30 renewals failed" in lines
    waiting = a_status(TaskStatus(), LeaseStatus(held=False, attempts=1, failures=0))
    assert "Lease not held: this process creates no tasks; 0 of 1 renewals failed" in shown(status_view(waiting))
    assert not any(line.startswith(("tasks", "Lease")) for line in shown(status_view(a_status(TaskStatus()))))


def test_the_sum_of_several_detectors_adds_their_tasks() -> None:
    added = total([a_status(CHANGED), a_status(TaskStatus(created=1, refused={"Invalid": 2}))])
    assert added.tasks == TaskStatus(
        created=3, recreated=1, retried=4, refused={"Forbidden": 3, "Invalid": 3}, pending=1
    )
    assert "tasks refused: 3 Forbidden, 3 Invalid" in shown(total_view(added))


def test_a_scrape_has_tasks_and_lease() -> None:
    found = samples(a_status(CHANGED, LeaseStatus(held=True, attempts=30, failures=2)))
    assert found["task_changes_total", "created"] == 2
    assert found["task_changes_total", "ended"] == 0
    assert found["task_refusals_total", "Forbidden"] == 3
    assert (found["task_retries_total",], found["tasks_pending",]) == (4, 1)
    assert (found["lease_held",], found["lease_failures_total",]) == (1, 2)
    assert ("lease_held",) not in samples(a_status(CHANGED))
