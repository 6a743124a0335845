"""The deploy action: the demands of open episodes, kept equal to the ApplicationTasks in a store.

The engine passes the full set of demands whenever it changes. The reconciler makes the store match it: it creates
missing tasks (including tasks deleted by hand), sets the end of tasks that are over, and patches those that changed. It
is level-triggered, not edge-triggered, so an outage of the store delays it and loses nothing. An episode that starts
and ends within one outage leaves no task, because its demand no longer exists.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from detector.actions.deploy.ledger import Ledger, StoreChange, differences
from detector.actions.deploy.stores import (
    Snapshot,
    StoredTask,
    StoreUnavailableError,
    TaskExistsError,
    TaskRefusedError,
    TaskStore,
)
from detector.actions.tracing import EpisodeTraces
from detector.engine.episodes.demands import Demand, to_task
from detector.engine.episodes.plain import plain
from wayside.kubernetes.workqueue import WorkQueue
from wayside.process.backoff import Backoff

_log = logging.getLogger(__name__)


@dataclass
class DeployCounts:
    """The work of the reconciler since its start, as numbers of tasks."""

    created: int = 0
    recreated: int = 0
    """Recreated because another client deleted them while they were demanded."""
    adopted: int = 0
    """Adopted because they existed when they were to be created: the response to an earlier request was lost."""
    replaced: int = 0
    """Deleted and recreated because the demand differs in an immutable field."""
    patched: int = 0
    ended: int = 0
    retried: int = 0
    """Attempts that failed because the store was unavailable or busy."""
    refused: Counter[str] = field(default_factory=Counter)
    """Attempts that the store rejected, by its reason. Each is retried at the next resync."""


class DemandReconciler:
    """Keeps the tasks of one holder equal to its demands. Any thread may call `update`, one event loop all else."""

    def __init__(
        self,
        store: TaskStore,
        *,
        now: Callable[[], int] = time.time_ns,
        concurrency: int = 16,
        permitted: asyncio.Event | None = None,
        traces: EpisodeTraces | None = None,
    ) -> None:
        """Prepare.

        Args:
            store: the holder's tasks.
            now: nanoseconds since the epoch: the end of a task whose demand is gone at an unknown time.
            concurrency: how many tasks are changed at the same time; the changes of one task are always in order.
            permitted: nothing is changed while this is not set, e.g. `HolderLease.held`. Default: always permitted.
            traces: receives the tasks that were created.
        """
        self._traces = traces
        self._store = store
        self._now = now
        self._permitted = permitted
        self._lock = threading.Lock()
        self._handed: tuple[Mapping[str, Demand], dict[str, int]] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ledger = Ledger()
        self._queue: WorkQueue[str] = WorkQueue("task", self._reconcile, concurrency)
        self._probing = asyncio.Lock()
        self._away = Backoff(0.1, 5.0)
        self._reachable = asyncio.Event()
        self._pause = 0.0
        self._logged: set[tuple[StoreChange, str]] = set()
        self._stopping = asyncio.Event()
        self._deadline = 0.0
        self.counts = DeployCounts()
        self.snapshots = 0
        """Number of snapshots of the store."""

    @property
    def pending(self) -> int:
        """Number of tasks in the work queue."""
        return len(self._queue)

    def update(self, demands: Mapping[str, Demand], ended: Mapping[str, int]) -> None:
        """Pass the current demands. Never waits for the store; only the latest set counts.

        Args:
            demands: all that is demanded, by task name.
            ended: the ends of episodes whose demands are gone, by task name, in nanoseconds since the epoch. They are
                remembered until the tasks have ended.
        """
        with self._lock:
            waiting = self._handed
            self._handed = (dict(demands), {**(waiting[1] if waiting else {}), **ended})
            loop = self._loop
        if waiting is None and loop is not None:
            with suppress(RuntimeError):  # the loop is closed: the next start reconciles
                loop.call_soon_threadsafe(self._accept)

    async def run(self) -> None:
        """Reconcile until `stop`. Nothing is changed before the first `update` and the store's first snapshot."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
        self._accept()
        async with asyncio.TaskGroup() as group:
            working = [group.create_task(self._follow()), group.create_task(self._queue.run())]
            await self._stopping.wait()
            self._accept()
            with suppress(TimeoutError):
                async with asyncio.timeout(self._deadline if self._may_change() else 0.0):
                    await self._queue.idle()
            if self.pending:
                _log.warning("%d tasks are not reconciled yet; the next start completes them", self.pending)
            for task in working:
                task.cancel()

    def stop(self, deadline: float = 3.0) -> None:
        """Let `run` finish its work within `deadline` seconds, and return. Live tasks are kept."""
        self._deadline = deadline
        self._stopping.set()

    def _accept(self) -> None:
        """Apply the demands of the last `update`."""
        with self._lock:
            handed, self._handed = self._handed, None
        if handed is not None:
            self._enqueue(self._ledger.accept(*handed))

    def _may_change(self) -> bool:
        return self._permitted is None or self._permitted.is_set()

    async def _follow(self) -> None:
        async for change in self._store.follow():
            self._enqueue(self._ledger.apply(change))
            if isinstance(change, Snapshot):
                self.snapshots += 1
                self._reachable.set()

    def _enqueue(self, names: Iterable[str]) -> None:
        for name in names:
            self._queue.add(name)

    async def _reconcile(self, name: str) -> None:
        if self._permitted is not None:
            await self._permitted.wait()
        if self._away.failures:
            async with self._probing:  # a single task probes whether the store is back
                if self._away.failures:
                    with suppress(TimeoutError):
                        await asyncio.wait_for(self._reachable.wait(), self._pause)
                    await self._attend(name)
                    return
        await self._attend(name)

    async def _attend(self, name: str) -> None:
        """Make the changes that a task needs, one after the other."""
        failures = self._away.failures
        step = StoreChange.NOTHING
        try:
            while (step := self._ledger.next(name)) is not StoreChange.NOTHING:
                await self._apply(step, name)
                self._away.succeed()
        except StoreUnavailableError as error:
            self.counts.retried += 1
            if failures == self._away.failures:  # otherwise another task has counted this outage's newest failure
                self._unavailable(error)
            self._queue.add(name)
        except TaskRefusedError as error:
            self._refused(step, name, error)

    async def _apply(self, step: StoreChange, name: str) -> None:
        """Make one change of a task. Raises `TaskStoreError`."""
        demand, stored = (self._ledger.demands or {}).get(name), (self._ledger.stored or {}).get(name)
        if step is StoreChange.CREATE and demand is not None:
            await self._create(name, demand)
        elif stored is not None:
            try:
                await self._change(step, name, demand, stored)
            except TaskRefusedError:
                # Possibly only because our copy is outdated: ended, deleted or recreated in the meantime.
                current = await self._store.get(name)
                self._ledger.put(name, current)
                if self._ledger.next(name) is step and current is not None and current.version == stored.version:
                    raise

    async def _create(self, name: str, demand: Demand) -> None:
        began = self._now()
        try:
            task = to_task(demand) if self._traces is None else self._traces.task(demand, to_task(demand))
        except ValueError as error:
            raise TaskRefusedError("Invalid", f"cannot create an ApplicationTask from the demand: {error}") from error
        deleted = name in self._ledger.held
        try:
            self._ledger.put(name, await self._store.create(task))
        except TaskExistsError as error:
            found = await self._store.get(name)
            if found is None or found.leaving:
                why = "it is being deleted" if found else "it belongs to another holder"
                raise TaskRefusedError("AlreadyExists", f"the name is already in use ({why}): {error}") from error
            self._ledger.put(name, found)
            self.counts.adopted += 1
        else:
            if deleted:
                self.counts.recreated += 1
                _log.info("recreated the task %s, which another client deleted", name)
            else:
                self.counts.created += 1
            if self._traces is not None and not deleted:
                self._traces.created(demand, began)

    async def _change(self, step: StoreChange, name: str, demand: Demand | None, stored: StoredTask) -> None:
        if step is StoreChange.END:
            end = self._ledger.end_of(name)
            self._ledger.put(name, await self._store.end(stored, self._now() if end is None else end))
            self.counts.ended += 1
        elif step is StoreChange.REPLACE and demand is not None:
            _log.info("replacing the task %s: %s", name, ", ".join(differences(demand, stored)) or "it has ended")
            await self._store.remove(stored)
            self._ledger.put(name, None)
            self.counts.replaced += 1
        elif step is StoreChange.SET_PARAMETERS and demand is not None:
            self._ledger.put(name, await self._store.set_parameters(stored, plain(demand.parameters)))
            self.counts.patched += 1
            if self._ledger.next(name) is StoreChange.SET_PARAMETERS:
                raise TaskRefusedError("Altered", "the store changed the parameters that it received")

    def _unavailable(self, error: StoreUnavailableError) -> None:
        if not self._away.failures:
            _log.warning("cannot update tasks; retrying with backoff: %s", error)
        self._reachable.clear()
        self._pause = self._away.fail(error.retry_after)

    def _refused(self, step: StoreChange, name: str, error: TaskRefusedError) -> None:
        self.counts.refused[error.reason] += 1
        if (step, error.reason) not in self._logged:
            self._logged.add((step, error.reason))
            _log.error(
                "cannot %s the task %s (further failures of this kind are counted, not logged): %s",
                step.value,
                name,
                error,
            )
