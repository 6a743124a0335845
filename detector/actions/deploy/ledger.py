"""The demanded and the stored tasks, and the next step for each, which depends on nothing else. Never waits, no I/O."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Any

from detector.actions.deploy.stores import Snapshot, StoredTask, Update
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.plain import plain
from wayside.times import format_time


class StoreChange(Enum):
    """One change of the store."""

    NOTHING = "nothing"
    CREATE = "create"
    REPLACE = "replace"
    """Delete the task, then recreate it: the demand differs in an immutable field."""
    SET_PARAMETERS = "set parameters"
    END = "end"


def next_step(demand: Demand | None, stored: StoredTask | None, held: bool) -> StoreChange:
    """The next change that brings the store closer to the demand.

    Args:
        demand: the demand with the task's name; None: there is none (any more).
        stored: the task, if there is one and it is the holder's own.
        held: whether this process has seen the task live for this demand. If it has, and the task has ended, then
            another client ended it on purpose and it stays ended. If not, it is left from an earlier run over the same
            data.
    """
    if demand is None:
        return StoreChange.END if stored is not None and stored.live else StoreChange.NOTHING
    if stored is None:
        return StoreChange.CREATE
    if stored.leaving:
        return StoreChange.NOTHING  # until it is gone
    if not stored.live:
        return StoreChange.NOTHING if held else StoreChange.REPLACE
    if differences(demand, stored):
        return StoreChange.REPLACE
    if plain(demand.parameters) != stored.task.spec.parameters:
        return StoreChange.SET_PARAMETERS
    return StoreChange.NOTHING


def differences(demand: Demand, stored: StoredTask) -> list[str]:
    """The immutable fields in which the task differs from the demand."""
    spec = stored.task.spec
    event = spec.event
    pairs: dict[str, tuple[Any, Any]] = {
        "templateName": (demand.template, spec.template_name),
        "operation": (demand.operation, spec.operation),
        "priority": (demand.priority, spec.priority),
        "requester.detectorName": (demand.detector, spec.requester.detector_name),
        "requester.subjects": (list(demand.episode.clients), spec.requester.subjects),
    }
    if event is not None:
        pairs |= {
            "event.id": (demand.episode.id, event.id),
            "event.onsetTime": (format_time(demand.episode.onset_time), event.onset_time),
        }
    return [field for field, (wanted, found) in pairs.items() if wanted != found]


_log = logging.getLogger(__name__)

_REMEMBERED_ENDS = 10_000
"""Ends of episodes whose tasks are not known to have ended. Beyond this number the oldest are forgotten."""


class Ledger:
    """The latest demands and stored tasks, by task name.

    `accept` and `apply` return the names of the tasks that need a change.
    """

    def __init__(self) -> None:
        self.demands: Mapping[str, Demand] | None = None
        """None before the first `accept`: until then nothing may be changed, and above all nothing ended."""
        self.stored: dict[str, StoredTask] | None = None
        """None before the first snapshot: until then the content of the store is unknown."""
        self.held: set[str] = set()
        """Demands whose task this process has seen live."""
        self.surrendered: set[str] = set()
        """Demands whose task another client ended; they stay without a task."""
        self._ends: dict[str, int] = {}

    def accept(self, demands: Mapping[str, Demand], ended: Mapping[str, int]) -> list[str]:
        """Replace the full set of demands, and note the ends of some that are gone (ns since the epoch)."""
        before = self.demands
        self.demands = demands
        self._ends.update(ended)
        while len(self._ends) > _REMEMBERED_ENDS:
            del self._ends[next(iter(self._ends))]
        self.held &= demands.keys()
        self.surrendered &= demands.keys()
        if before is None:
            return self._due(demands.keys() | (self.stored or {}).keys())
        changed = [name for name, demand in demands.items() if before.get(name) != demand]
        return self._due([*(name for name in before if name not in demands), *changed])

    def apply(self, change: Snapshot | Update) -> list[str]:
        """Apply a change of the store."""
        known = self.stored or {}
        if isinstance(change, Snapshot):
            # Our own writes after the snapshot are newer than it.
            newer = {name: stored for name, stored in known.items() if stored.version > change.version}
            self.stored = {**change.tasks, **newer}
            return self._due(self.stored.keys() | (self.demands or {}).keys())
        earlier = known.get(change.name)
        if self.stored is None or (earlier is not None and earlier.version > change.version):
            return []
        self.put(change.name, change.stored)
        return self._due((change.name,))

    def put(self, name: str, stored: StoredTask | None) -> None:
        """Apply the response to a change by this process."""
        if self.stored is None:
            self.stored = {}
        if stored is None:
            self.stored.pop(name, None)
        else:
            self.stored[name] = stored

    def next(self, name: str) -> StoreChange:
        """The next step for a task."""
        if self.demands is None or self.stored is None:
            return StoreChange.NOTHING
        demand, stored = self.demands.get(name), self.stored.get(name)
        step = next_step(demand, stored, name in self.held)
        if step is StoreChange.NOTHING and stored is not None:
            self._note_in_sync(name, demand, stored)
        return step

    def _note_in_sync(self, name: str, demand: Demand | None, stored: StoredTask) -> None:
        """No change is needed: note that the task exists, that its end was written, or that another client ended it."""
        if stored.leaving:
            return
        if demand is None:
            self._ends.pop(name, None)
        elif stored.live:
            self.held.add(name)
        elif name not in self.surrendered:
            self.surrendered.add(name)
            _log.warning("another client ended the task %s, although its episode is open; the task stays ended", name)

    def end_of(self, name: str) -> int | None:
        """When the demand ended, in nanoseconds since the epoch; None if it is unknown."""
        return self._ends.get(name)

    def _due(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if self.next(name) is not StoreChange.NOTHING]
