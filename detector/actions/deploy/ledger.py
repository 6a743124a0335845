"""The demanded and the stored tasks, and the next step for each. Never waits, no I/O."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

from detector.actions.deploy.steps import StoreChange, next_step
from detector.actions.deploy.stores import Snapshot, StoredTask, Update
from detector.engine.episodes.demands import Demand

_log = logging.getLogger(__name__)

_REMEMBERED_ENDS = 10_000
"""Ends of episodes whose tasks are not known to have ended. Beyond this number the oldest are forgotten."""


class Ledger:
    """The latest knowledge of both sides, by task name.

    `accept` and `see` return the names that need work.
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

    def see(self, change: Snapshot | Update) -> list[str]:
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
        """Apply the response to a change of our own."""
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
            self._settled(name, demand, stored)
        return step

    def _settled(self, name: str, demand: Demand | None, stored: StoredTask) -> None:
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
