"""Conditions that keep their time of transition, and the Kubernetes Events that follow from their changes. Pure.

Two of them follow from the others: Ready and Stalled, by which kstatus, kubectl and GitOps tools judge. kstatus takes
an object with Ready=True as current, with Ready=False as in progress, and with Stalled=True as failed. So Stalled is
there only while waiting alone helps nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wayside.api.base import Condition
from wayside.times import format_seconds

MAXIMUM_MESSAGE = 4096  # characters, as the CRDs allow


@dataclass(frozen=True, slots=True)
class Aspect:
    """What a condition should be now."""

    type: str
    holds: bool
    reason: str
    message: str = ""

    @property
    def status(self) -> str:
        """The condition's status."""
        return "True" if self.holds else "False"


def updated(
    known: Iterable[Condition],
    aspects: Iterable[Aspect],
    generation: int,
    now: float,
    *,
    only_while: Iterable[str] = (),
) -> list[Condition]:
    """The conditions that the aspects make; one keeps its time of transition while its status stays.

    Conditions of other types are kept, but for those of the types `only_while`. `now` is in seconds since 1970.
    """
    aspects = list(aspects)
    gone = set(only_while) - {each.type for each in aspects}
    by_type = {each.type: each for each in known if each.type not in gone}
    for aspect in aspects:
        old = by_type.get(aspect.type)
        kept = old is not None and old.status == aspect.status
        by_type[aspect.type] = Condition(
            type=aspect.type,
            status=aspect.status,
            reason=aspect.reason,
            message=cut(aspect.message),
            observed_generation=generation,
            last_transition_time=old.last_transition_time if old is not None and kept else format_seconds(now),
        )
    return list(by_type.values())


def find(conditions: Iterable[Condition], type_: str) -> Condition | None:
    """The condition of the type, or None."""
    return next((each for each in conditions if each.type == type_), None)


def find_raw(status: Mapping[str, Any], type_: str) -> Mapping[str, Any]:
    """The condition of the type in the status of an object as it was read; empty where there is none."""
    conditions = status.get("conditions") or ()
    return next((each for each in conditions if isinstance(each, Mapping) and each.get("type") == type_), {})


def holds(conditions: Iterable[Condition], type_: str) -> bool:
    """Whether there is a condition of the type and it is True."""
    condition = find(conditions, type_)
    return condition is not None and condition.status == "True"


def from_first(
    known: Iterable[Condition], type_: str, now: tuple[str, str] | None, otherwise: tuple[str, str]
) -> Iterator[Aspect]:
    """A condition that is absent until it is True for the first time, and False afterwards.

    `now` and `otherwise`: its reason and message while it is True, None where it is not, and while it is False.
    """
    if now is not None:
        yield Aspect(type_, True, *now)
    elif find(known, type_) is not None:
        yield Aspect(type_, False, *otherwise)


def changed(old: Iterable[Condition], new: Iterable[Condition]) -> list[Condition]:
    """The conditions whose status or reason changed: what is worth a Kubernetes Event."""
    before = {each.type: (each.status, each.reason) for each in old}
    return [each for each in new if before.get(each.type) != (each.status, each.reason)]


def cut(message: str, longest: int = MAXIMUM_MESSAGE) -> str:
    """The message, cut to this number of characters where it is longer."""
    return message if len(message) <= longest else f"{message[: longest - 1]}…"


READY = "Ready"
STALLED = "Stalled"


def concluded(
    known: Sequence[Condition], aspects: Sequence[Aspect], generation: int, now: float, *, stalled: Collection[str]
) -> list[Condition]:
    """The conditions that the aspects, at least one, make, with Ready and Stalled as follows from them.

    The object is ready if all aspects hold. `now` in seconds since 1970; `stalled`: the reasons that somebody has to
    correct the object for.
    """
    failing = next((each for each in aspects if not each.holds), None)
    if failing is None:
        follow = [Aspect(READY, True, READY, aspects[-1].message)]
    else:
        follow = [Aspect(READY, False, failing.reason, failing.message)]
        if failing.reason in stalled:
            follow.append(Aspect(STALLED, True, failing.reason, failing.message))
    return updated(known, [*aspects, *follow], generation, now, only_while=(STALLED,))
