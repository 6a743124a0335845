"""The episodes that were open when the detector stopped: those of its live tasks, then those of its state volume."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import aclosing
from dataclasses import dataclass

from detector.actions.deploy.stores import Snapshot, TaskStore, live_demands
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.open_episodes import OpenEpisode
from detector.live.state import StateFile


@dataclass(frozen=True, slots=True)
class Restored:
    """The input of the engine's restore."""

    demands: Sequence[Demand] = ()
    """Of live tasks, oldest first."""
    episodes: Sequence[OpenEpisode] = ()
    """Of the state volume, except those whose task has ended: the detector ended it and was killed before it wrote."""


async def what_was_open(store: TaskStore, state: StateFile | None) -> Restored:
    """Read both. Waits while the store is unavailable; cancel it to give up."""
    async with aclosing(store.follow()) as changes:
        async for change in changes:
            if isinstance(change, Snapshot):
                episodes = [] if state is None else state.load()
                over = _ended(change)
                return Restored(live_demands(change), [each for each in episodes if each.record.id not in over])
    raise AssertionError("the stream of a store's changes ended")


def _ended(snapshot: Snapshot) -> set[str]:
    """The ids of the episodes whose tasks have ended."""
    specs = (stored.task.spec for stored in snapshot.tasks.values() if not stored.live)
    return {spec.event.id for spec in specs if spec.event is not None}
