"""Conditions with their transition times, and the Kubernetes Events that follow from their changes. Pure.

Two of them follow from the others: Ready and Stalled, which kstatus, kubectl and GitOps tools read. For kstatus, an
object with Ready=True is current, with Ready=False in progress, and with Stalled=True failed. So Stalled is present
only while waiting does not help.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wayside.api.base import Condition
from wayside.times import format_seconds

MAXIMUM_MESSAGE = 4096  # characters, as the CRDs allow


@dataclass(frozen=True, slots=True)
class ConditionState:
    """The current state of a condition; `unknown`: its status is Unknown."""

    type: str
    holds: bool
    reason: str
    message: str = ""
    unknown: bool = False

    @property
    def status(self) -> str:
        """The condition's status."""
        return "Unknown" if self.unknown else str(self.holds)


def updated(
    known: Iterable[Condition],
    states: Iterable[ConditionState],
    generation: int,
    now: float,
    *,
    only_while: Iterable[str] = (),
) -> list[Condition]:
    """The updated conditions, sorted by type; each keeps its transition time while its status is unchanged.

    Conditions of other types are kept, except for the types `only_while`. `now` is in seconds since 1970.
    """
    states = list(states)
    gone = set(only_while) - {each.type for each in states}
    by_type = {each.type: each for each in known if each.type not in gone}
    for state in states:
        old = by_type.get(state.type)
        kept = old is not None and old.status == state.status
        by_type[state.type] = Condition(
            type=state.type,
            status=state.status,
            reason=state.reason,
            message=cut(state.message),
            observed_generation=generation,
            last_transition_time=old.last_transition_time if old is not None and kept else format_seconds(now),
        )
    return sorted(by_type.values(), key=lambda each: each.type)


def find(conditions: Iterable[Condition], type_: str) -> Condition | None:
    """The condition of the type, or None."""
    return next((each for each in conditions if each.type == type_), None)


def find_raw(status: Mapping[str, Any], type_: str) -> Mapping[str, Any]:
    """The condition of the type in a raw status; empty if there is none."""
    conditions = status.get("conditions") or ()
    return next((each for each in conditions if isinstance(each, Mapping) and each.get("type") == type_), {})


def holds(conditions: Iterable[Condition], type_: str) -> bool:
    """Whether there is a condition of the type and it is True."""
    condition = find(conditions, type_)
    return condition is not None and condition.status == "True"


def from_first(
    known: Iterable[Condition], type_: str, now: tuple[str, str] | None, otherwise: tuple[str, str]
) -> Iterator[ConditionState]:
    """A condition that is absent until it is True for the first time, and False afterwards.

    `now`: its reason and message while it is True, None if it is not; `otherwise`: those while it is False.
    """
    if now is not None:
        yield ConditionState(type_, True, *now)
    elif find(known, type_) is not None:
        yield ConditionState(type_, False, *otherwise)


def changed(old: Iterable[Condition], new: Iterable[Condition]) -> list[Condition]:
    """The conditions whose status or reason changed: each may need a Kubernetes Event."""
    before = {each.type: (each.status, each.reason) for each in old}
    return [each for each in new if before.get(each.type) != (each.status, each.reason)]


def cut(message: str, longest: int = MAXIMUM_MESSAGE) -> str:
    """The message, cut to this number of characters."""
    return message if len(message) <= longest else f"{message[: longest - 1]}…"


READY = "Ready"
STALLED = "Stalled"


def concluded(
    known: Sequence[Condition],
    states: Sequence[ConditionState],
    generation: int,
    now: float,
    *,
    stalled: Collection[str],
) -> list[Condition]:
    """The conditions updated with at least one state, and Ready and Stalled, which follow from them.

    The object is ready if all states hold; otherwise Ready has the reason of the first that does not. `now` is in
    seconds since 1970; `stalled`: the reasons that require a correction of the object.
    """
    failing = next((each for each in states if not each.holds), None)
    if failing is None:
        follow = [ConditionState(READY, True, READY, states[-1].message)]
    else:
        follow = [replace(failing, type=READY)]
        if failing.reason in stalled:
            follow.append(ConditionState(STALLED, True, failing.reason, failing.message))
    return updated(known, [*states, *follow], generation, now, only_while=(STALLED,))
