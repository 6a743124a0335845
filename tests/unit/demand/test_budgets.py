"""Budgets of tasks: in any order of changes, the oldest tasks are within the budget."""

from __future__ import annotations

from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from application_manager.cache.budget_index import BudgetIndex
from application_manager.core.claims.operations import VerdictKind
from application_manager.core.holders.policies import HolderPolicy, TaskPolicy
from tests.unit.manager_objects import task
from wayside.api import ApplicationTask
from wayside.api.applicationtask import Requester

POLICY = TaskPolicy(3, (HolderPolicy("*", "a*", max_tasks=2),))
NAMES = tuple(f"t{number}" for number in range(8))
HOLDERS = dict(zip(NAMES, ("a1", "a1", "a1", "a2", "b", "b", None, None), strict=True))

Step = tuple[Literal["enter", "leave"], str]


def made(name: str) -> ApplicationTask:
    """A task; those with later names are older."""
    bare = task(name)
    metadata = bare.metadata.model_copy(update={"creation_timestamp": f"2026-01-01T00:00:{9 - int(name[1])}0Z"})
    requester = Requester(holder=HOLDERS[name])
    return bare.model_copy(update={"metadata": metadata, "spec": bare.spec.model_copy(update={"requester": requester})})


def expected(live: set[str]) -> set[str]:
    """The tasks within both budgets, counted from the oldest."""
    within: list[str] = []
    taken: dict[str | None, int] = {}
    for name in sorted(live, reverse=True):
        holder = HOLDERS[name]
        taken[holder] = taken.get(holder, 0) + 1
        bound = holder is not None and holder.startswith("a")
        if not (bound and taken[holder] > 2):
            within.append(name)
    return set(within[:3])


@given(st.lists(st.tuples(st.sampled_from(("enter", "leave")), st.sampled_from(NAMES)), max_size=40))
def test_the_oldest_tasks_are_within_the_budget_and_every_change_is_reported(steps: list[Step]) -> None:
    index = BudgetIndex(POLICY)
    live: set[str] = set()
    for step, name in steps:
        before = expected(live)
        one = made(name)
        if step == "enter":
            live.add(name)
            moved = index.enter(one)
        else:
            live.discard(name)
            moved = index.leave((one.namespace, name))
        within = {each for each in live if index.verdict((one.namespace, each)) is None}
        assert within == expected(live)
        assert {each for _, each in moved} >= {each for each in before ^ within if each != name}
        assert len(moved) <= 3  # looks at the task that two budgets move in opposite directions, too


def test_a_task_beyond_the_budget_waits_and_reports_the_budget() -> None:
    index = BudgetIndex(POLICY)
    for name in ("t2", "t1", "t0"):
        index.enter(made(name))
    verdict = index.verdict((made("t0").namespace, "t0"))
    assert verdict is not None
    assert verdict.kind is VerdictKind.WAITING
    assert "a1 has reached the limit of 2 unfinished tasks" in verdict.message


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("town", "must be NAMESPACE/HOLDER:"),
        ("town/det:max-tasks=many", "'max-tasks=many'"),
        ("town/det:operations=Stop", "'Stop'"),
        ("town/det:max-tasks=-1", "max-tasks"),
    ],
)
def test_an_invalid_policy_is_rejected_with_the_valid_form(text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem) as refused:
        HolderPolicy.parse(text)
    assert "must be " in str(refused.value)
