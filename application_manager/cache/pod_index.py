"""An index of the pods with problems, by instance.

Pods are recognised by the instance's label, which the rendering puts into pod templates. Of those that run well, which
are nearly all, nothing is kept here.
"""

from __future__ import annotations

from application_manager.cache.store import MembersByGroup, name_of
from application_manager.core.health.pods import Trouble, summary, trouble
from application_manager.core.objects.ownership import instance_of
from application_manager.core.objects.policy import Name
from wayside.kubernetes.resources import Object


class PodIndex:
    """Troubles of pods."""

    def __init__(self) -> None:
        self._troubles: MembersByGroup[Name, Name, Trouble] = MembersByGroup()

    def note(self, pod: Object) -> bool:
        """Note a pod as it is now; whether that changes the `troubles` of its instance."""
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
        """Forget a pod that is deleted; whether that changes the `troubles` of its instance."""
        instance = instance_of(pod)
        if instance is None:
            return False
        before = self.troubles(instance)
        self._troubles.drop(instance, name_of(pod))
        return before != self.troubles(instance)

    def troubles(self, instance: Name) -> list[Trouble]:
        """The different troubles of an instance's pods, the most important first."""
        return summary(self._troubles.get(instance, {}).values())
