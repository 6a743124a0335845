"""An index of places: which instances may run in namespaces with limits.

A place depends on what each instance requests, and on the order of all requests. So only the instances that changed
since are decided again, and the order is determined again when any request differs. Namespaces without limits cost
nothing.
"""

from __future__ import annotations

from application_manager.core.demand.places import Placement
from application_manager.core.objects.policy import Name


class PlaceIndex:
    """The placement of each namespace that has limits, and the instances that changed since.

    `being_made`: instances that were requested from the API server, which may or may not have them.
    """

    def __init__(self) -> None:
        self.being_made: set[Name] = set()
        self._placements: dict[str, Placement] = {}
        self._touched: dict[str, set[str]] = {}

    def touch(self, name: Name) -> None:
        """Note that an instance, or what demands it, changed."""
        if name[0] in self._placements:
            self._touched.setdefault(name[0], set()).add(name[1])

    def forget(self) -> None:
        """Drop all placements: another manager has acted since."""
        self._placements.clear()
        self._touched.clear()
        self.being_made.clear()

    def placement(self, namespace: str) -> Placement | None:
        """The placement noted last; None where there is none."""
        return self._placements.get(namespace)

    def stale(self, placement: Placement, namespace: str, now: float) -> set[str]:
        """The instances whose request may differ from the one in the placement noted last."""
        return placement.due(now) | self._touched.get(namespace, set())

    def note(self, namespace: str, placement: Placement | None) -> None:
        """Note a placement that has all changes in it; None where the namespace has no limits."""
        self._touched.pop(namespace, None)
        if placement is None:
            self._placements.pop(namespace, None)
        else:
            self._placements[namespace] = placement
