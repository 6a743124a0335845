"""The pods with problems, by instance.

A pod belongs to the instance in its label, which rendering adds to pod templates. Pods without problems, nearly all,
are not stored.
"""

from __future__ import annotations

from application_manager.cache.store import MembersByGroup, name_of
from application_manager.core.health.pods import Trouble, summary, trouble
from application_manager.core.objects.ownership import instance_of
from application_manager.core.objects.policy import Name
from wayside.kubernetes.resources import Object


class PodIndex:
    """The problems of pods."""

    def __init__(self) -> None:
        self._troubles: MembersByGroup[Name, Name, Trouble] = MembersByGroup()

    def note(self, pod: Object) -> bool:
        """Note the current state of a pod; returns whether the `troubles` of its instance changed."""
        instance = instance_of(pod)
        if instance is None:
            return False
        before = self.troubles(instance)
        found = trouble(pod)
        if found is None:
            self._troubles.drop(instance, name_of(pod))
        else:
            self._troubles.put(instance, name_of(pod), found)
        return before != self.troubles(instance)

    def forget(self, pod: Object) -> bool:
        """Forget a deleted pod; returns whether the `troubles` of its instance changed."""
        instance = instance_of(pod)
        if instance is None:
            return False
        before = self.troubles(instance)
        self._troubles.drop(instance, name_of(pod))
        return before != self.troubles(instance)

    def troubles(self, instance: Name) -> list[Trouble]:
        """The distinct problems of an instance's pods, the most important first."""
        return summary(self._troubles.get(instance, {}).values())
