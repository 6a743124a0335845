"""Indexes of decisions: which instances have a place in namespaces with limits, and which tasks use a fallback.

A place depends on the request of each instance, and on the order of all requests. So only the instances that changed
are decided again, and the order is computed again when a request differs. Namespaces without limits cost nothing.
"""

from __future__ import annotations

from application_manager.core.demand.fallback import Fallback
from application_manager.core.demand.places import Placement
from application_manager.core.objects.policy import Name


class PlaceIndex:
    """The placement of each namespace that has limits, and the instances that changed since.

    `being_created`: instances that were requested from the API server, which may or may not have them.
    """

    def __init__(self) -> None:
        self.being_created: set[Name] = set()
        self._placements: dict[str, Placement] = {}
        self._touched: dict[str, set[str]] = {}

    def touch(self, name: Name) -> None:
        """Note that an instance, or its demand, changed."""
        if name[0] in self._placements:
            self._touched.setdefault(name[0], set()).add(name[1])

    def forget(self) -> None:
        """Drop all placements: another manager has been active since."""
        self._placements.clear()
        self._touched.clear()
        self.being_created.clear()

    def placement(self, namespace: str) -> Placement | None:
        """The last placement; None if there is none."""
        return self._placements.get(namespace)

    def stale(self, placement: Placement, namespace: str, now: float) -> set[str]:
        """The instances whose request may differ from the one in the last placement."""
        return placement.due(now) | self._touched.get(namespace, set())

    def note(self, namespace: str, placement: Placement | None) -> None:
        """Note a placement that contains all changes; None if the namespace has no limits."""
        self._touched.pop(namespace, None)
        if placement is None:
            self._placements.pop(namespace, None)
        else:
            self._placements[namespace] = placement


class FallbackIndex:
    """Fallbacks of templates, and of instances that are not ready."""

    def __init__(self) -> None:
        self._templates: dict[Name, str] = {}
        self._fallbacks: dict[Name, Fallback] = {}

    def note_template(self, template: Name, other: str | None) -> None:
        """Note the fallback template of a template; None if it has none, or was deleted."""
        self._templates.pop(template, None)
        if other is not None:
            self._templates[template] = other

    def falling_to(self, template: Name) -> list[Name]:
        """The templates that fall back to this one."""
        return [name for name, other in self._templates.items() if (name[0], other) == template]

    def targets(self, namespace: str) -> set[str]:
        """The templates of a namespace to which others fall back."""
        return {other for name, other in self._templates.items() if name[0] == namespace}

    def affected(self, instance: Name, to: Fallback | None) -> set[str]:
        """The instances that get or lose tasks if the fallback of this instance's tasks becomes `to`."""
        before = self._fallbacks.get(instance)
        if before == to:
            return set()
        return (before.instances if before else set()) | (to.instances if to else set())

    def note(self, instance: Name, to: Fallback | None) -> None:
        """Note the fallback of an instance's tasks; None if there is none."""
        self._fallbacks.pop(instance, None)
        if to is not None:
            self._fallbacks[instance] = to

    def instances_of(self, template: Name) -> set[Name]:
        """The instances of a template whose tasks use their fallback."""
        fallbacks = (each for of, each in self._fallbacks.items() if (of[0], each.template) == template)
        return {(template[0], instance) for each in fallbacks for instance in each.instances}
