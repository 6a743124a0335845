"""The decision about one instance."""

from __future__ import annotations

from dataclasses import dataclass, field

from application_manager.core.claims.operations import Verdict
from application_manager.core.demand.fallback import Fallback
from application_manager.core.demand.places import Rank
from wayside.api import ApplicationInstance
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL


@dataclass(frozen=True, slots=True)
class Decision:
    """The decision about one instance.

    Attributes:
        parameters: the merged values; None if they stay unchanged.
        tasks: the tasks that contribute, in their order.
        verdicts: of all tasks that claim the instance, by task name.
        generations: the generations of these tasks that the decision is based on.
        release_time: when it is released, in seconds since 1970; None: it stays.
        next_change: when this decision changes by itself, in seconds since 1970; None: never.
        paused: whether a person paused the instance and its objects.
        withheld: whether the pause keeps new merged values from the instance.
        capped: a message about each merged sum that is capped at its parameter's bound.
        too_large: why the merged values are too large, so that it keeps its previous ones; empty if they are not.
        baseline: whether the template itself demands it.
        suspended: whether it is to be suspended; None if that stays unchanged.
        suspender: the task that suspends it.
        rank: the rank of the demand, which determines who has a place under a limit; None without demand.
        ran: whether a task that demands it was served before.
        yields: why it is released early: another instance has its place.
        overdue: the readyTimeout that it exceeded; empty if it did not.
        fallback: the fallback of its tasks, if it is overdue and its template has one.
        stands_in_for: the instances that are not ready, and whose tasks it serves.
        borrowed: these tasks; their own instances decide about them.
    """

    name: str
    template: str
    key: str | None = None
    parameters: dict[str, object] | None = None
    tasks: tuple[str, ...] = ()
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    generations: dict[str, int] = field(default_factory=dict)
    release_time: float | None = None
    next_change: float | None = None
    paused: bool = False
    withheld: bool = False
    capped: tuple[str, ...] = ()
    too_large: str = ""
    baseline: bool = False
    suspended: bool | None = None
    suspender: str | None = None
    rank: Rank | None = None
    ran: bool = False
    yields: str = ""
    overdue: str = ""
    fallback: Fallback | None = None
    stands_in_for: tuple[str, ...] = ()
    borrowed: frozenset[str] = frozenset()

    @property
    def demanded(self) -> bool:
        """Whether a task, or the template itself, demands it."""
        return bool(self.tasks) or self.baseline


def is_managed(instance: ApplicationInstance) -> bool:
    """Whether the manager created the instance; a person's instance is never changed or released."""
    return instance.metadata.labels.get(MANAGED_BY_LABEL) == MANAGED_BY
