"""The recordings on other systems that were requested and not stopped yet: stored on the state volume for the next
start.

Without it, a recording whose episode ended just when the detector was killed would continue until its maximumDuration.
The file is small and replaced atomically; the action's own thread writes it.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from detector.actions.trigger.orders import Order

_log = logging.getLogger(__name__)

_VERSION = 1


class OrderJournal:
    """The unfinished orders of one action."""

    def __init__(self, path: Path) -> None:
        """Raises nothing: a journal that cannot be read or written is logged, and ignored."""
        self._path = path
        self._written: list[str] | None = None
        self.failures = 0
        """Number of failed writes."""

    def load(self) -> dict[str, Order]:
        """The unfinished orders of the previous run, by id."""
        try:
            document: Any = json.loads(self._path.read_bytes())
            if document["version"] != _VERSION:
                raise ValueError(f"its version is {document['version']}, not {_VERSION}")
            return {each["id"]: Order(each["id"], each["rendered"], each["event"]) for each in document["orders"]}
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            _log.error("cannot read %s; not stopping any recordings listed in it: %s", self._path, error)
            return {}

    def save(self, orders: Iterable[Order]) -> None:
        """Store the unfinished orders; writes only if they changed."""
        wanted = {order.id: order for order in orders}
        if list(wanted) == self._written or (self._written is None and not wanted):
            return
        try:
            self._write(wanted)
        except OSError as error:
            self.failures += 1
            _log.error("cannot write %s; after a restart, recordings may not be stopped: %s", self._path, error)
        self._written = list(wanted)

    def _write(self, orders: Mapping[str, Order]) -> None:
        if not orders:
            self._path.unlink(missing_ok=True)
            return
        document = {
            "version": _VERSION,
            "orders": [{"id": each.id, "rendered": each.rendered, "event": each.event} for each in orders.values()],
        }
        self._path.parent.mkdir(parents=True, exist_ok=True)
        draft = self._path.with_suffix(".new")
        with draft.open("w", encoding="utf-8") as file:
            file.write(json.dumps(document, separators=(",", ":")))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(self._path)
