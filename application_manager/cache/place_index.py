"""Who has a place in namespaces with limits: kept up to date instance by instance.

What a place depends on is each instance's own decision, and the order of all of them. So only the instances that were
touched since are decided again, and the order is looked at anew when any of them asks for something else. Namespaces
without limits cost nothing here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from application_manager.cluster.store import Name
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.places import Candidate, Limits, Place, places

Alone = Callable[[Name, float], tuple[Decision, Candidate | None] | None]
"""What should become of an instance were there no limits, and what it asks for; None: no one knows or wants it."""


@dataclass
class _Namespace:
    limits: Limits
    candidates: dict[Name, Candidate] = field(default_factory=dict)
    touched: set[Name] = field(default_factory=set)
    times: dict[Name, float] = field(default_factory=dict)  # when a decision changes by itself
    given: dict[str, Place] = field(default_factory=dict)
    stale: bool = True
    until: float = float("inf")


class PlaceIndex:
    """Places of all instances.

    Attributes:
        changed: told of each instance whose place changed.
        being_made: instances that were asked for from the API server, and may be there or not.
    """

    def __init__(self, alone: Alone, names: Callable[[str], Iterable[Name]]) -> None:
        """`names` gives all instances of a namespace that there are, or could be."""
        self._alone = alone
        self._names = names
        self._namespaces: dict[str, _Namespace] = {}
        self.changed: Callable[[Name], None] = lambda _: None
        self.being_made: set[Name] = set()

    def touch(self, name: Name) -> None:
        """Note that an instance, or what demands it, changed."""
        known = self._namespaces.get(name[0])
        if known is not None:
            known.touched.add(name)

    def forget(self) -> None:
        """Know of no place any more: another manager has acted since."""
        self._namespaces.clear()
        self.being_made.clear()

    def place(self, name: Name, limits: Limits, now: float) -> Place | None:
        """The instance's place under the limits of its namespace; None where no limit concerns it."""
        if not limits:
            self._namespaces.pop(name[0], None)
            return None
        known = self._namespaces.get(name[0])
        if known is None:
            known = self._namespaces[name[0]] = _Namespace(limits, touched=set(self._names(name[0])))
        elif known.limits != limits:
            known.limits, known.stale = limits, True
        known.touched.add(name)
        self._look(name, known, now)
        return known.given.get(name[1])

    def _look(self, asking: Name, known: _Namespace, now: float) -> None:
        due = {each for each, when in known.times.items() if when <= now}
        for name in known.touched | due:
            self._note(name, known, now)
        known.touched.clear()
        if not known.stale and now < known.until:
            return
        before = known.given
        known.given = places(known.candidates.values(), known.limits, now)
        known.stale = False
        ends = [each.protected_until for each in known.candidates.values() if now < each.protected_until]
        known.until = min(ends, default=float("inf"))
        for each in known.given.keys() | before.keys():
            if each != asking[1] and known.given.get(each) != before.get(each):
                self.changed((asking[0], each))

    def _note(self, name: Name, known: _Namespace, now: float) -> None:
        found = self._alone(name, now)
        known.times.pop(name, None)
        if found is not None and found[0].next_change is not None:
            known.times[name] = found[0].next_change
        asks = found[1] if found is not None else None
        if asks == known.candidates.get(name):
            return
        known.stale = True
        if asks is None:
            del known.candidates[name]
        else:
            known.candidates[name] = asks
