"""The administrator's limits on the number of tasks, and on the tasks of holders. Pure.

The chart's admission policy verifies who a holder is; this module limits its requests. Tasks of people have no holder;
roles limit them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Self

from application_manager.core.claims.claims import RefusalReason
from application_manager.core.claims.operations import Verdict, VerdictKind
from wayside.api import ApplicationTask
from wayside.api.operation import Operation

_FORM = (
    "NAMESPACE/HOLDER:max-tasks=N,max-priority=N,operations=Deploy+Reconfigure+Suspend, with at least one of "
    "the three limits"
)


@dataclass(frozen=True, slots=True)
class HolderPolicy:
    """The limits of holders whose namespace and name match these patterns, with `*` and `?`.

    `max_tasks`: the maximum number of unfinished tasks of each, `max_priority`: the maximum priority of its tasks;
    None: no limit.
    """

    namespace: str
    holder: str
    max_tasks: int | None = None
    max_priority: int | None = None
    operations: frozenset[Operation] = frozenset(Operation)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse a value of the option `--holder-policy`. Raises ValueError, which names the part and the form."""
        who, colon, rest = text.partition(":")
        namespace, slash, holder = who.partition("/")
        if not (colon and slash and namespace and holder):
            raise ValueError(f"must be {_FORM}; got {text!r}")
        numbers: dict[str, int | None] = {"max-tasks": None, "max-priority": None}
        operations = frozenset(Operation)
        for part in rest.split(","):
            name, _, value = part.partition("=")
            if name == "operations":
                operations = frozenset(_operation(each, text) for each in value.split("+"))
            elif name in numbers and value.removeprefix("-").isdigit():
                numbers[name] = int(value)
            else:
                raise ValueError(f"must be {_FORM}; got {part!r} in {text!r}")
        if (numbers["max-tasks"] or 0) < 0:
            raise ValueError(f"max-tasks must be 0 or more; got {text!r}")
        return cls(namespace, holder, numbers["max-tasks"], numbers["max-priority"], operations)

    def matches(self, namespace: str, holder: str) -> bool:
        """Whether it applies to this holder."""
        return fnmatchcase(namespace, self.namespace) and fnmatchcase(holder, self.holder)


@dataclass(frozen=True, slots=True)
class TaskPolicy:
    """The limits of tasks: the maximum per namespace, None for no limit, and those of holders, by the first match."""

    max_tasks: int | None = None
    holders: Sequence[HolderPolicy] = field(default=())

    def of(self, namespace: str, holder: str | None) -> HolderPolicy | None:
        """The policy of a holder; None for people, and if no policy matches."""
        if holder is None:
            return None
        return next((each for each in self.holders if each.matches(namespace, holder)), None)

    def refusal(self, task: ApplicationTask) -> Verdict | None:
        """Why the policy of the task's holder forbids the task, regardless of other tasks; None if it does not."""
        holder = task.spec.requester.holder
        policy = self.of(task.namespace, holder)
        if policy is None:
            return None
        spec = task.spec
        if spec.operation not in policy.operations:
            allowed = " or ".join(sorted(policy.operations)) or "nothing"
            why = f"spec.operation: {spec.operation} is not allowed for holder {holder}, which may {allowed}"
        elif policy.max_priority is not None and spec.priority > policy.max_priority:
            why = f"spec.priority: {spec.priority} is above {policy.max_priority}, the maximum for holder {holder}"
        else:
            return None
        message = f"{why}: change the rule, or have the administrator change --holder-policy"
        return Verdict(VerdictKind.REFUSED, RefusalReason.NOT_ALLOWED, message)


def _operation(text: str, whole: str) -> Operation:
    try:
        return Operation(text)
    except ValueError:
        raise ValueError(f"operations must be {' or '.join(Operation)}; got {text!r} in {whole!r}") from None
