"""The documents of an action that its next run needs, on the state volume (`spec.state`).

Without a state volume, or if its disk fails, everything else continues; documents that would not survive a restart are
counted.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from detector.actions.base import ActionContext
from detector.actions.store import DurableStore, StoreError, action_store
from wayside.names import encode

_log = logging.getLogger(__name__)

_UNREAD = "journal entries that could not be read"

T = TypeVar("T")


class Journal:
    """JSON documents by key. Not thread-safe."""

    def __init__(self, context: ActionContext, folder: str, unkept: str, version: str = "") -> None:
        """Open it with the documents of earlier runs.

        Args:
            context: of the action.
            folder: in that of `spec.state`.
            unkept: what is counted for a document that cannot be stored.
            version: only documents of earlier runs with the same one are taken over.
        """
        self._context, self._unkept = context, unkept
        self._store: DurableStore | None = None
        detector = context.configuration().detector
        whose = (detector.namespace, context.holder, context.rule.name, context.action)
        name = "_".join(map(encode, (*whose, version) if version else whose))
        self.path = None if detector.spec.state is None else Path(detector.spec.state.path) / folder / name
        """The path of its files, without a suffix; None without a state volume."""
        if self.path is None:
            return

        def lose(count: int, why: str) -> None:
            context.lose(_UNREAD, count, why)

        try:
            self._store = action_store(self.path.parent, self.path.name, lose)
        except StoreError as error:
            _log.error("action %s of EventRule %s has no journal: %s", context.action, context.rule.name, error)
            context.lose(unkept, 1, str(error))

    @property
    def is_durable(self) -> bool:
        """Whether documents survive a restart."""
        return self._store is not None

    def put(self, key: str, document: Mapping[str, Any], *, sync: bool = False) -> None:
        """Store a document, or replace the one of that key; with `sync` it survives a power failure as well."""
        if self._store is None:
            return
        try:
            self._store.put(key, json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode())
            if sync:
                self._store.sync()
        except StoreError as error:
            self._context.lose(self._unkept, 1, str(error))

    def load(self, key: str, make: Callable[[Any], T]) -> T | None:
        """The document, converted by `make`; None if there is none, or if it cannot be read."""
        if self._store is None:
            return None
        try:
            record = self._store.get(key)
            return None if record is None else make(json.loads(record))
        except StoreError as error:
            self._context.lose(_UNREAD, 1, str(error))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            self._context.lose(_UNREAD, 1, f"{type(error).__name__} in {key}")
            self.drop([key])
        return None

    def load_all(self, prefix: str, make: Callable[[Any], T]) -> dict[str, T]:
        """The same for all keys that begin with `prefix`, oldest first, without those that cannot be read."""
        found = {key: self.load(key, make) for key in self.keys(prefix)}
        return {key: made for key, made in found.items() if made is not None}

    def keys(self, prefix: str) -> list[str]:
        """The keys that begin with `prefix`, oldest first."""
        try:
            return [] if self._store is None else self._store.keys(prefix)
        except StoreError as error:
            self._context.lose(_UNREAD, 1, str(error))
            return []

    def drop(self, keys: Iterable[str]) -> None:
        """Remove documents."""
        if self._store is None:
            return
        gone = list(keys)
        try:
            self._store.drop(*gone)
        except StoreError as error:
            self._context.lose("journal entries that could not be dropped", len(gone), str(error))

    def close(self) -> None:
        """Close the file: the next run takes over the remaining entries. The last call."""
        if self._store is None:
            return
        try:
            self._store.close()
        except StoreError as error:
            _log.error("cannot close the journal of action %s: %s", self._context.action, error)
