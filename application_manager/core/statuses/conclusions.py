"""The conditions that conclude from others: Ready and Stalled, by which kstatus, kubectl and GitOps tools judge. Pure.

kstatus takes an object with Ready=True as current, with Ready=False as in progress, and with Stalled=True as failed. So
Stalled is there only while waiting alone helps nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from application_manager.core.conditions import Aspect, updated
from wayside.api.base import Condition

READY = "Ready"
STALLED = "Stalled"


def concluded(
    known: Sequence[Condition], aspects: Sequence[Aspect], generation: int, now: float, *, stalled: Collection[str]
) -> tuple[Condition, ...]:
    """The conditions that the aspects make, with Ready and Stalled as follows from them.

    Args:
        known: as they are.
        aspects: at least one; the object is ready if all of them hold.
        generation: the object's.
        now: seconds since 1970.
        stalled: the reasons that somebody has to correct the object for.
    """
    failing = next((each for each in aspects if not each.holds), None)
    if failing is None:
        follow = [Aspect(READY, True, READY, aspects[-1].message)]
    else:
        follow = [Aspect(READY, False, failing.reason, failing.message)]
        if failing.reason in stalled:
            follow.append(Aspect(STALLED, True, failing.reason, failing.message))
    return updated(known, [*aspects, *follow], generation, now, only_while=(STALLED,))
