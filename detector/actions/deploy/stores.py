"""The interface of a task store for the reconciler: the API server or a folder of files."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any, Protocol

from detector.engine.episodes.demands import Demand, from_task
from wayside.api import ApplicationTask
from wayside.api.base import JsonValue


@dataclass(frozen=True)
class StoredTask:
    """A stored task."""

    task: ApplicationTask
    version: int
    """Grows with each change of anything in the store, so that the newer of two states is known."""

    @property
    def live(self) -> bool:
        """Whether its demand has not ended."""
        return self.task.spec.end_time is None

    @property
    def leaving(self) -> bool:
        """Whether it is deleted but not yet removed from the store."""
        return self.task.metadata.deletion_timestamp is not None


@dataclass(frozen=True)
class Snapshot:
    """All existing tasks of the holder, by name."""

    tasks: Mapping[str, StoredTask]
    version: int


@dataclass(frozen=True)
class Update:
    """One task changed, or was removed (`stored` is None)."""

    name: str
    stored: StoredTask | None
    version: int


class TaskStoreError(Exception):
    """The store could not carry out a request."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason
        """One word, for counting."""


class StoreUnavailableError(TaskStoreError):
    """The store is unavailable or busy: a retry may succeed soon."""

    def __init__(self, reason: str, message: str, retry_after: float = 0.0) -> None:
        super().__init__(reason, message)
        self.retry_after = retry_after
        """Seconds to wait as requested by the store; 0 if not given."""


class TaskRefusedError(TaskStoreError):
    """The store rejects it; retrying without a change is useless."""


class TaskExistsError(TaskStoreError):
    """A task of this name exists, perhaps of another holder."""


class TaskStore(Protocol):
    """The tasks of one holder. Every method but `follow` raises a `TaskStoreError`."""

    def follow(self) -> AsyncGenerator[Snapshot | Update, None]:
        """A snapshot, then changes, with a new snapshot at least every half minute. Never ends, raises nothing."""

    async def get(self, name: str) -> StoredTask | None:
        """The holder's task of this name; None if there is none, or if it belongs to another holder."""

    async def create(self, task: ApplicationTask) -> StoredTask:
        """Store a new task. `TaskExistsError` if the name is taken."""

    async def set_parameters(self, stored: StoredTask, parameters: Mapping[str, JsonValue]) -> StoredTask:
        """Replace a task's parameters, if it still is the same task."""

    async def end(self, stored: StoredTask, end_time: int) -> StoredTask:
        """Set a task's end (nanoseconds since the epoch), if it still is the same task."""

    async def remove(self, stored: StoredTask) -> None:
        """Delete a task, if it still is the same one."""


async def restore(store: TaskStore) -> list[Demand]:
    """The demands of the holder's live tasks, oldest first: the episodes that were open when the detector stopped.

    Waits as long as the store is unavailable; cancel it to give up.
    """
    async with aclosing(store.follow()) as changes:
        async for change in changes:
            if isinstance(change, Snapshot):
                return live_demands(change)
    raise AssertionError("the stream of a store's changes ended")


def live_demands(snapshot: Snapshot) -> list[Demand]:
    """The demands of the tasks that have not ended, oldest first."""
    live = (from_task(each.task) for each in snapshot.tasks.values() if each.live and not each.leaving)
    return sorted((demand for demand in live if demand), key=lambda each: (each.episode.start_time, each.name))


def belongs_to(task: ApplicationTask, holder: str) -> bool:
    """Whether the holder emitted this task, and may therefore change it."""
    return task.spec.requester.holder == holder and from_task(task) is not None


def task_manifest(task: ApplicationTask) -> dict[str, Any]:
    """The task in the form that is sent or written: without empty fields."""
    document = task.to_json()
    document["metadata"] = {key: value for key, value in document["metadata"].items() if value}
    event = task.spec.event
    if event is not None and event.classification is not None:
        document["spec"]["event"]["classification"] = event.classification.to_json()
    document.pop("status", None)
    return document
