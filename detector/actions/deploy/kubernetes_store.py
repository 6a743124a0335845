"""Tasks in the API server."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Iterator, Mapping
from contextlib import contextmanager

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
from detector.engine.episodes.demands import holder_label
from wayside.api import API_VERSION, ApplicationTask
from wayside.api.applicationtask import HOLDER_LABEL
from wayside.api.base import JsonValue
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, RequestError
from wayside.kubernetes.reflector import Changed, Deleted, Reflector, Replaced, version_of
from wayside.kubernetes.resources import Object, Resource
from wayside.times import format_time

_log = logging.getLogger(__name__)

TASKS = Resource(API_VERSION, ApplicationTask.__name__, ApplicationTask.plural)


class KubernetesTaskStore:
    """The tasks of one holder in one namespace. Tasks of others are neither listed nor changed."""

    def __init__(self, client: Client, namespace: str, holder: str, resync: float = 30.0) -> None:
        """Prepare; `resync`: seconds after which all tasks are listed again, even if the watch seems complete."""
        self._client = client
        self._namespace = namespace
        self._holder = holder
        self._resync = resync
        self._unreadable: set[str] = set()

    async def follow(self) -> AsyncGenerator[Snapshot | Update, None]:
        """See `TaskStore`."""
        own = f"{HOLDER_LABEL}={holder_label(self._holder)}"
        reflector = Reflector(self._client, TASKS, self._namespace, labels=own, resync=self._resync)
        async for change in reflector.follow():
            match change:
                case Replaced(objects, version):
                    found = (self._own(obj) for obj in objects)
                    yield Snapshot({stored.task.name: stored for stored in found if stored}, version)
                case Changed(obj):
                    if stored := self._own(obj):
                        yield Update(stored.task.name, stored, stored.version)
                case Deleted(obj):
                    if self._own(obj):
                        yield Update(obj["metadata"]["name"], None, version_of(obj))

    async def get(self, name: str) -> StoredTask | None:
        """See `TaskStore`."""
        with _store_errors():
            found = await self._client.get(TASKS, self._namespace, name)
        return None if found is None else self._own(found)

    async def create(self, task: ApplicationTask) -> StoredTask:
        """See `TaskStore`."""
        with _store_errors():
            body = task_manifest(task)
            body["metadata"]["namespace"] = self._namespace
            return _stored(await self._client.create(TASKS, body))

    async def set_parameters(self, stored: StoredTask, parameters: Mapping[str, JsonValue]) -> StoredTask:
        """See `TaskStore`."""
        return await self._set(stored, "parameters", dict(parameters))

    async def end(self, stored: StoredTask, end_time: int) -> StoredTask:
        """See `TaskStore`."""
        return await self._set(stored, "endTime", format_time(end_time))

    async def remove(self, stored: StoredTask) -> None:
        """See `TaskStore`."""
        metadata = stored.task.metadata
        with _store_errors():
            await self._client.delete(TASKS, self._namespace, metadata.name, metadata.uid)

    async def _set(self, stored: StoredTask, field: str, value: JsonValue) -> StoredTask:
        # A JSON patch, since a merge patch would keep removed entries of a nested map.
        metadata = stored.task.metadata
        add = {"op": "add", "path": f"/spec/{field}", "value": value}
        with _store_errors():
            return _stored(await self._client.patch(TASKS, self._namespace, metadata.name, metadata.uid, [add]))

    def _own(self, obj: Object) -> StoredTask | None:
        """The task if it belongs to the holder and can be read; one of a newer version is ignored, and logged once."""
        try:
            stored = _stored(obj)
        except ValidationError as error:
            name = obj["metadata"]["name"]
            if name not in self._unreadable:
                self._unreadable.add(name)
                _log.warning("ignoring the ApplicationTask %s, which cannot be read: %s", name, error)
            return None
        return stored if belongs_to(stored.task, self._holder) else None


def _stored(obj: Object) -> StoredTask:
    # The manager owns the status, and a newer manager's may have unknown fields.
    read = {key: value for key, value in obj.items() if key != "status"}
    shape = {"apiVersion": API_VERSION, "kind": ApplicationTask.__name__}  # list items have neither
    return StoredTask(ApplicationTask.model_validate(shape | read), version_of(obj))


@contextmanager
def _store_errors() -> Iterator[None]:
    try:
        yield
    except RequestError as error:
        if isinstance(error, ApiError) and error.exists:
            raise TaskExistsError(error.reason, str(error)) from error
        if isinstance(error, ApiError) and (error.permanent or error.code == 409):
            raise TaskRefusedError(error.reason, str(error)) from error
        raise StoreUnavailableError(error.reason, str(error), error.retry_after or 0.0) from error
    except ValidationError as error:
        raise TaskRefusedError("Unreadable", f"cannot read the stored ApplicationTask: {error}") from error
