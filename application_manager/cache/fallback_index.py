"""An index of fallbacks: which template falls back to which, and which tasks use the fallback."""

from __future__ import annotations

from application_manager.core.demand.fallback import Fallback
from application_manager.core.objects.policy import Name


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

    def targets(self, namespace: str) -> set[str]:
        """The templates of a namespace to which others fall back."""
        return {other for name, other in self._templates.items() if name[0] == namespace}

    def moved(self, instance: Name, to: Fallback | None) -> set[str]:
        """The instances that get or lose tasks if those of this instance turn to `to` now."""
        before = self._turned.get(instance)
        if before == to:
            return set()
        return (before.instances if before else set()) | (to.instances if to else set())

    def note(self, instance: Name, to: Fallback | None) -> None:
        """Note what an instance's tasks turn to; None where they do not."""
        self._turned.pop(instance, None)
        if to is not None:
            self._turned[instance] = to

    def instances_of(self, template: Name) -> set[Name]:
        """The instances of a template that tasks turned to."""
        turned = (each for of, each in self._turned.items() if (of[0], each.template) == template)
        return {(template[0], instance) for each in turned for instance in each.instances}
