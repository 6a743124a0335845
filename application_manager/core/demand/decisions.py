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
    """What should become of one instance.

    Attributes:
        parameters: the merged values; None where they stay as they are.
        tasks: the tasks that contribute, in their order.
        verdicts: of all tasks that claim the instance, by task name.
        generations: of these tasks, that the decision is about.
        release_time: when it goes, in seconds since 1970; None: it stays.
        next_change: when this decision changes by itself, in seconds since 1970; None: not at all.
        paused: whether a person wants the instance and its objects left as they are.
        withheld: whether the pause keeps merged values from the instance.
        capped: a message about each merged sum that is held at its parameter's bound.
        too_large: why the merged values are too large and it keeps those that it has; empty where they are not.
        baseline: whether the template demands it by itself.
        suspended: whether it is to be at zero; None where that stays as it is.
        suspender: the task that suspends it.
        rank: of the demand, which determines who has a place where there is a limit; None where nobody demands it.
        ran: whether a task that demands it was served before.
        yields: why it goes though its time has not come: another has its place.
        overdue: the readyTimeout that it is beyond; empty where it is not.
        fallback: what its tasks turn to meanwhile, if its template has a fallback.
        stands_in_for: the instances that are not ready, and whose tasks it serves.
        borrowed: these tasks, of which it has not the last word.
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
    def wanted(self) -> bool:
        """Whether any task demands it, or its template by itself."""
        return bool(self.tasks) or self.baseline


def is_managed(instance: ApplicationInstance) -> bool:
    """Whether the manager made the instance; a person's is never changed or released."""
    return instance.metadata.labels.get(MANAGED_BY_LABEL) == MANAGED_BY
