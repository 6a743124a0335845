"""Any task reaches the demanded state step by step, and then nothing more is done."""

from __future__ import annotations

import dataclasses

from hypothesis import given
from hypothesis import strategies as st

from detector.actions.deploy.ledger import Ledger, StoreChange, next_step
from detector.actions.deploy.stores import Snapshot, StoredTask, Update
from detector.engine.episodes.demands import Demand, to_task
from tests.unit.actions.test_demands import DEMAND
from wayside.api.operation import Operation

DEMANDS = st.builds(
    lambda template, operation, parameters: dataclasses.replace(
        DEMAND, template=template, operation=operation, parameters=parameters
    ),
    st.sampled_from(["one", "other"]),
    st.sampled_from(Operation),
    st.dictionaries(st.sampled_from(["p", "q"]), st.none() | st.floats() | st.lists(st.integers(0, 2))),
)
STORED = st.builds(lambda demand, ended: StoredTask(to_task(demand, 5 if ended else None), 1), DEMANDS, st.booleans())


def after(step: StoreChange, demand: Demand | None, stored: StoredTask | None) -> StoredTask | None:
    """The stored task after the step."""
    if step is StoreChange.CREATE and demand is not None and stored is None:
        return StoredTask(to_task(demand), 2)
    assert stored is not None
    if step is StoreChange.REPLACE:
        return None
    spec = stored.task.spec
    if step is StoreChange.END:
        changed = spec.model_copy(update={"end_time": "2026-01-01T00:00:00Z"})
    else:
        assert demand is not None
        changed = spec.model_copy(update={"parameters": to_task(demand).spec.parameters})
    return StoredTask(stored.task.model_copy(update={"spec": changed}), 2)


@given(st.none() | DEMANDS, st.none() | STORED, st.booleans())
def test_at_most_three_steps_reach_the_demanded_state(
    demand: Demand | None, stored: StoredTask | None, held: bool
) -> None:
    before = stored
    for _ in range(3):
        step = next_step(demand, stored, held)
        if step is StoreChange.NOTHING:
            break
        stored = after(step, demand, stored)
    assert next_step(demand, stored, held) is StoreChange.NOTHING
    if demand is None:
        assert stored is None or not stored.live
    elif held and before is not None and not before.live:
        assert stored is before, "somebody ended it on purpose"
    else:
        assert stored is not None
        assert stored.task.spec == to_task(demand).spec


def task(end: int | None = None, version: int = 1) -> StoredTask:
    return StoredTask(to_task(DEMAND, end), version)


def test_nothing_is_due_before_both_sides_are_known() -> None:
    ledger = Ledger()
    assert ledger.apply(Snapshot({DEMAND.name: task()}, 1)) == []
    assert ledger.accept({}, {}) == [DEMAND.name]
    ledger = Ledger()
    assert ledger.accept({DEMAND.name: DEMAND}, {}) == []
    assert ledger.apply(Snapshot({}, 1)) == [DEMAND.name]


def test_late_reports_of_the_store_do_not_undo_newer_knowledge() -> None:
    ledger = Ledger()
    ledger.accept({DEMAND.name: DEMAND}, {})
    ledger.apply(Snapshot({}, 3))
    ledger.put(DEMAND.name, task(version=5))
    assert ledger.apply(Snapshot({}, 4)) == [], "a list from before the creation"
    assert ledger.apply(Update(DEMAND.name, None, 4)) == [], "an old deletion"
    assert ledger.apply(Update(DEMAND.name, task(end=1, version=4), 4)) == [], "an old end"
    assert ledger.next(DEMAND.name) is StoreChange.NOTHING
    assert ledger.apply(Snapshot({}, 6)) == [DEMAND.name], "now it is really gone"


def test_an_end_is_remembered_until_the_task_has_ended() -> None:
    ledger = Ledger()
    ledger.accept({DEMAND.name: DEMAND}, {})
    ledger.apply(Snapshot({DEMAND.name: task()}, 1))
    assert ledger.accept({}, {DEMAND.name: 77}) == [DEMAND.name]
    ledger.accept({}, {})
    assert ledger.end_of(DEMAND.name) == 77
    ledger.put(DEMAND.name, task(end=77, version=2))
    assert ledger.next(DEMAND.name) is StoreChange.NOTHING
    assert ledger.end_of(DEMAND.name) is None
