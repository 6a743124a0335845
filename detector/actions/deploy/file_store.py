"""Tasks as files, one each: the same reconciler works without a cluster, and the folder shows the demands."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

import yaml
from pydantic import ValidationError

from detector.actions.deploy.stores import (
    Snapshot,
    StoredTask,
    StoreUnavailableError,
    TaskExistsError,
    TaskRefusedError,
    Update,
    belongs_to,
    task_manifest,
)
from wayside.api import ApplicationTask
from wayside.api.base import JsonValue
from wayside.manifests import to_yaml
from wayside.process.files import replace_file
from wayside.times import format_time, parse_time

_log = logging.getLogger(__name__)

Result = TypeVar("Result")


class FileTaskStore:
    """The tasks of one holder in a folder: `<name>.yaml` each, replaced atomically, so that no reader sees half a task.

    A task's creationTimestamp is its event's start, to the second: the same drive gives the same files.
    """

    def __init__(self, folder: Path, holder: str, interval: float = 0.5) -> None:
        """Prepare; `interval`: seconds between two scans for changes by others."""
        self._folder = _Folder(folder, holder)
        self._lock = asyncio.Lock()
        self._interval = interval

    async def follow(self) -> AsyncGenerator[Snapshot | Update, None]:
        """See `TaskStore`. All changes come as snapshots."""
        away = False
        while True:
            try:
                snapshot = await self._run(self._folder.read_changes)
            except StoreUnavailableError as error:
                if not away:
                    _log.warning("cannot read the tasks in %s; retrying with backoff: %s", self._folder.path, error)
                away = True
            else:
                away = False
                yield snapshot
            await asyncio.sleep(self._interval)

    async def all(self) -> dict[str, ApplicationTask]:
        """All tasks of the holder, including ended ones, by name."""
        snapshot = await self._run(self._folder.read_changes)
        return {name: stored.task for name, stored in snapshot.tasks.items()}

    async def get(self, name: str) -> StoredTask | None:
        """See `TaskStore`."""
        snapshot = await self._run(self._folder.read_changes)
        return snapshot.tasks.get(name)

    async def create(self, task: ApplicationTask) -> StoredTask:
        """See `TaskStore`."""
        return await self._run(lambda: self._folder.create(task))

    async def set_parameters(self, stored: StoredTask, parameters: Mapping[str, JsonValue]) -> StoredTask:
        """See `TaskStore`."""
        return await self._run(lambda: self._folder.change(stored.task.name, "parameters", dict(parameters)))

    async def end(self, stored: StoredTask, end_time: int) -> StoredTask:
        """See `TaskStore`."""
        return await self._run(lambda: self._folder.change(stored.task.name, "end_time", format_time(end_time)))

    async def remove(self, stored: StoredTask) -> None:
        """See `TaskStore`."""
        await self._run(lambda: self._folder.remove(stored.task.name))

    async def _run(self, work: Callable[[], Result]) -> Result:
        """Run disk work, one at a time and off the event loop."""
        async with self._lock:
            try:
                return await asyncio.to_thread(work)
            except OSError as error:
                raise StoreUnavailableError("Disk", f"{self._folder.path}: {error}") from error


def write_tasks_yaml(path: Path, tasks: Iterable[ApplicationTask]) -> None:
    """Write tasks into one file of several documents, in the order of their event's start and name."""
    documents = [task_manifest(_created(task)) for task in sorted(tasks, key=_order)]
    replace_file(path, to_yaml(documents))


class _Read(NamedTuple):
    """A file when it was last read; it is read again only when its inode, size or modification time differ."""

    mark: tuple[int, int, int]
    stored: StoredTask | None


class _Folder:
    """The files, with blocking access."""

    def __init__(self, path: Path, holder: str) -> None:
        self.path = path
        self._holder = holder
        self._files: dict[str, _Read] = {}
        self._version = 0

    def read_changes(self) -> Snapshot:
        """Read the files that changed since the last call."""
        self.path.mkdir(parents=True, exist_ok=True)
        found: dict[str, _Read] = {}
        for file in os.scandir(self.path):
            if not file.name.endswith(".yaml") or file.name.startswith("."):
                continue
            try:
                status = file.stat()
            except FileNotFoundError:
                continue  # removed in the meantime
            mark = (status.st_ino, status.st_size, status.st_mtime_ns)
            known = self._files.get(file.name)
            found[file.name] = known if known and known.mark == mark else _Read(mark, self._read(Path(file.path)))
        self._files = found
        tasks = {read.stored.task.name: read.stored for read in found.values() if read.stored}
        return Snapshot(tasks, self._next())

    def create(self, task: ApplicationTask) -> StoredTask:
        file = self._file(task.name)
        if file.exists():
            raise TaskExistsError("AlreadyExists", f"{file} exists")
        return self._write(_created(task))

    def change(self, name: str, field: str, value: JsonValue) -> StoredTask:
        stored = self.read_changes().tasks.get(name)
        if stored is None:
            raise TaskRefusedError("NotFound", f"{self._file(name)} does not exist, or belongs to another holder")
        if not stored.live:
            raise TaskRefusedError("Ended", f"{self._file(name)} has ended: an ended task cannot become active again")
        spec = stored.task.spec.model_copy(update={field: value})
        return self._write(stored.task.model_copy(update={"spec": spec}))

    def remove(self, name: str) -> None:
        self._file(name).unlink(missing_ok=True)

    def _write(self, task: ApplicationTask) -> StoredTask:
        self.path.mkdir(parents=True, exist_ok=True)
        replace_file(self._file(task.name), to_yaml([task_manifest(task)]))
        return StoredTask(task, self._next())

    def _read(self, file: Path) -> StoredTask | None:
        try:
            task = ApplicationTask.model_validate(yaml.safe_load(file.read_text()))
        except FileNotFoundError:
            return None
        except (yaml.YAMLError, ValidationError, UnicodeDecodeError) as error:
            _log.warning("ignoring %s, which is not an ApplicationTask: %s", file, error)
            return None
        return StoredTask(task, self._next()) if belongs_to(task, self._holder) else None

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.yaml"

    def _next(self) -> int:
        self._version += 1
        return self._version


def _created(task: ApplicationTask) -> ApplicationTask:
    if task.spec.event is None:
        return task
    start = task.spec.event.start_time[: len("2026-01-01T00:00:00")] + "Z"
    metadata = task.metadata.model_copy(update={"creation_timestamp": start})
    return task.model_copy(update={"metadata": metadata})


def _order(task: ApplicationTask) -> tuple[int, str]:
    return (parse_time(task.spec.event.start_time) if task.spec.event else 0, task.name)
