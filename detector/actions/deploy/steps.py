"""The next step for one task, from the demanded and the stored state. Pure: the same input gives the same step."""

from __future__ import annotations

from enum import Enum
from typing import Any

from detector.actions.deploy.stores import StoredTask
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
