"""Which templates fall back to which, and whose tasks turned to whom: an index, kept up to date one by one."""

from __future__ import annotations

from application_manager.cluster.store import Name
from application_manager.core.demand.fallback import Fallback


class FallbackIndex:
    """Fallbacks of templates, and of instances that are not ready."""

    def __init__(self) -> None:
        self._templates: dict[Name, str] = {}
        self._turned: dict[Name, Fallback] = {}

    def note_template(self, template: Name, other: str | None) -> None:
        """Note to which template of its namespace one falls back; None where it does not, or is gone."""
        self._templates.pop(template, None)
        if other is not None:
            self._templates[template] = other

    def falling_to(self, template: Name) -> list[Name]:
        """The templates that fall back to this one."""
        return [name for name, other in self._templates.items() if (name[0], other) == template]

    def turn(self, instance: Name, now: Fallback | None) -> set[Name]:
        """Note what an instance's tasks turn to; returns the instances for which that is news."""
        before = self._turned.pop(instance, None)
        if now is not None:
            self._turned[instance] = now
        if before == now:
            return set()
        names = (before.instances if before else set()) | (now.instances if now else set())
        return {(instance[0], each) for each in names}

    def template_of(self, instance: Name) -> str | None:
        """The template of an instance that tasks turned to; None where none did."""
        turned = (each for of, each in self._turned.items() if of[0] == instance[0] and instance[1] in each.instances)
        return next((each.template for each in turned), None)

    def instances_of(self, template: Name) -> set[Name]:
        """The instances of a template that tasks turned to."""
        turned = (each for of, each in self._turned.items() if (of[0], each.template) == template)
        return {(template[0], instance) for each in turned for instance in each.instances}
