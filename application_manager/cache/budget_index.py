"""An incremental index of the tasks that are within the budgets of their holder and namespace.

The oldest tasks are within the budget. So neither a restart nor the order of arrival changes the result, and a served
task never loses its place to a newer one. A task beyond its holder's budget does not count against its namespace's
budget.
"""

from __future__ import annotations

from bisect import bisect_left, insort

from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.demand.placing import LIMIT_REACHED
from application_manager.core.holders.policies import TaskPolicy
from application_manager.core.objects.policy import Name
from wayside.api import ApplicationTask

_Age = tuple[str, Name]
"""The creation time and the name of a task: the sort key."""


class _Budget:
    """Tasks in their order; the first `limit` of them are within the budget."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.order: list[_Age] = []

    def within(self, age: _Age) -> bool:
        return bisect_left(self.order, age) < self.limit

    def add(self, age: _Age) -> _Age | None:
        """Add a task; returns the task that is beyond the budget now, if any."""
        insort(self.order, age)
        if len(self.order) <= self.limit or not self.within(age):
            return None
        return self.order[self.limit]

    def remove(self, age: _Age) -> _Age | None:
        """Remove a task; returns the task that is within the budget now, if any."""
        index = bisect_left(self.order, age)
        del self.order[index]
        return self.order[self.limit - 1] if index < self.limit <= len(self.order) else None


class BudgetIndex:
    """The budgets of all namespaces and holders; unlimited ones store nothing."""

    def __init__(self, policy: TaskPolicy) -> None:
        self._policy = policy
        self._holders: dict[tuple[str, str], _Budget] = {}
        self._namespaces: dict[str, _Budget] = {}
        self._known: dict[Name, tuple[_Age, str | None]] = {}

    def enter(self, task: ApplicationTask) -> set[Name]:
        """Note an unfinished task; returns the other tasks whose result may have changed."""
        name = (task.namespace, task.name)
        age, holder = (task.metadata.creation_timestamp, name), task.spec.requester.holder
        if self._known.get(name) == (age, holder):
            return set()
        affected = self.leave(name)
        self._known[name] = age, holder
        own = self._of_holder(name, holder)
        displaced = own.add(age) if own is not None else None
        if own is None or own.within(age):
            affected |= self._take(age)
        if displaced is not None:
            affected |= {displaced[1]} | self._give_back(displaced)
        return affected - {name}

    def leave(self, name: Name) -> set[Name]:
        """Note that a task has ended; returns the other tasks whose result may have changed."""
        age, holder = self._known.pop(name, (None, None))
        if age is None:
            return set()
        own = self._of_holder(name, holder)
        if own is None:
            return self._give_back(age)
        affected = self._give_back(age) if own.within(age) else set()
        follower = own.remove(age)
        if not own.order and holder is not None:
            del self._holders[name[0], holder]
        return affected | ({follower[1]} | self._take(follower) if follower is not None else set())

    def verdict(self, name: Name) -> Verdict | None:
        """Why the task waits; None if it is within its budgets."""
        age, holder = self._known.get(name, (None, None))
        if age is None:
            return None
        own, all_ = self._of_holder(name, holder), self._of_namespace(name[0])
        if own is not None and not own.within(age):
            whose, limit = f"spec.requester.holder: {holder}", own.limit
        elif all_ is not None and not all_.within(age):
            whose, limit = f"metadata.namespace: {name[0]}", all_.limit
        else:
            return None
        message = (
            f"{whose} has reached the limit of {limit} unfinished tasks: this task waits until an older task ends; "
            "end some tasks, or have the administrator raise the limit"
        )
        return Verdict(VerdictKind.WAITING, LIMIT_REACHED, message)

    def _take(self, age: _Age) -> set[Name]:
        budget = self._of_namespace(age[1][0])
        displaced = budget.add(age) if budget is not None else None
        return {displaced[1]} if displaced is not None else set()

    def _give_back(self, age: _Age) -> set[Name]:
        budget = self._of_namespace(age[1][0])
        follower = budget.remove(age) if budget is not None else None
        return {follower[1]} if follower is not None else set()

    def _of_holder(self, name: Name, holder: str | None) -> _Budget | None:
        policy = self._policy.of(name[0], holder)
        if holder is None or policy is None or policy.max_tasks is None:
            return None
        return self._holders.setdefault((name[0], holder), _Budget(policy.max_tasks))

    def _of_namespace(self, namespace: str) -> _Budget | None:
        if self._policy.max_tasks is None:
            return None
        return self._namespaces.setdefault(namespace, _Budget(self._policy.max_tasks))
