"""What tasks may request: the administrator's limits on their number, and on what holders may do. Pure.

Who a holder is, the chart's admission policy makes sure of; what it may request is decided here. People's tasks have no
holder, and are limited by their roles.
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
    """What holders may do whose namespace and name match these patterns, with `*` and `?`.

    `max_tasks`: how many unfinished tasks each may have, `max_priority`: the highest of its tasks; None: any.
    """

    namespace: str
    holder: str
    max_tasks: int | None = None
    max_priority: int | None = None
    operations: frozenset[Operation] = frozenset(Operation)

    @classmethod
    def parse(cls, text: str) -> Self:
        """A policy as the option `--holder-policy` has it. Raises ValueError, which names the part and the form."""
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
        """Whether it is about this holder."""
        return fnmatchcase(namespace, self.namespace) and fnmatchcase(holder, self.holder)


@dataclass(frozen=True, slots=True)
class TaskPolicy:
    """The limits of tasks: of those of a namespace, None for any number, and of holders, by the first that matches."""

    max_tasks: int | None = None
    holders: Sequence[HolderPolicy] = field(default=())

    def of(self, namespace: str, holder: str | None) -> HolderPolicy | None:
        """What holds for a holder; None for people, and where nothing does."""
        if holder is None:
            return None
        return next((each for each in self.holders if each.matches(namespace, holder)), None)

    def refusal(self, task: ApplicationTask) -> Verdict | None:
        """Why the task's holder may not request that, whatever others do; None if it may."""
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
