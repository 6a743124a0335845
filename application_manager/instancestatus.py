"""Saying how an instance is, after the work: its status, its Events, and the news for its tasks.

Apart from the work itself, so that words never hold up what runs. Until a status is written, the world's record of the
instance stands for it; should we die before, the work is done again, and finds that nothing is left to do.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from application_manager.apply import Applied, Applier, ObjectKey
from application_manager.client import ApiError, Client, Object, Resource
from application_manager.core.byhand import PAUSE_ANNOTATION
from application_manager.core.conditions import Aspect
from application_manager.core.demand import Decision
from application_manager.core.pods import Trouble
from application_manager.core.readiness import not_ready
from application_manager.core.status import Service, difference, instance_status, suspension_aspect
from application_manager.recorder import Reason, Recorder
from application_manager.store import Name
from application_manager.world import Served, World
from wayside.api import ApplicationInstance
from wayside.api.applicationinstance import ApplicationInstanceStatus

_TROUBLES_SHOWN = 3

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class InstanceStatusWork:
    """Writes statuses of instances.

    Attributes:
        instances: where ApplicationInstances live.
        task_changed: asks for a task's status to be looked at.
        observe: takes an object that was read.
    """

    world: World
    client: Client
    applier: Applier
    recorder: Recorder
    instances: Resource
    task_changed: Callable[[Name], None]
    observe: Callable[[Object], None]

    async def reconcile(self, name: Name) -> None:
        """Write the instance's status if it is news.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        instance, record = self.world.instance(name), self.world.records.get(name)
        if instance is None or record is None or record.uid != instance.metadata.uid:
            return
        now = time.time()
        old = instance.status or ApplicationInstanceStatus()
        applied = record.applied
        live = self._live(instance, applied)
        suspended = suspension_aspect(instance, record.decision, live.values())
        ready = self._ready(instance, live)
        new = instance_status(
            instance, record.decision, applied.aspect, ready, applied.objects, record.digest, now, suspended
        )
        patch = difference(old.to_json() if instance.status else {}, new.to_json())
        if patch:
            uid = instance.metadata.uid
            try:
                self.observe(await self.client.patch_status(self.instances, name[0], name[1], uid, patch))
            except ApiError as error:
                if error.terminating or error.code in (404, 409):  # the instance is gone, or another has its name
                    return
                raise
            self.recorder.transitions(instance, old.conditions, new.conditions, now)
            if old.release_time is None and new.release_time is not None:
                note = f"no demand is left; it is released at {new.release_time} unless a new one comes"
                self.recorder.say(instance, Reason.LINGERING, note, now)
        # How many pods are ready stays with the instance: it changes often, and the tasks may be many.
        why_not = "" if applied.aspect.holds else applied.aspect.message
        reason = ""
        if applied.aspect.holds and suspended is not None and instance.spec.suspended:
            why_not, reason = suspended.message, ready.reason
        elif applied.aspect.holds and not ready.holds and (troubles := self.world.pods.troubles(name)):
            why_not, reason = _text(troubles), ready.reason
        if record.decision.withheld and applied.aspect.holds:
            why_not = f"instance {name[1]} is paused (annotation {PAUSE_ANNOTATION}): it does not get the task's values"
        serves = applied.aspect.holds and not record.decision.withheld
        service = Service(
            name[1],
            serves,
            serves and ready.holds,
            why_not,
            reason,
            suspended=instance.spec.suspended,
            stopped=serves and suspended is not None and suspended.holds,
        )
        self.tell(name, record.decision, service)

    def tell(self, name: Name, decision: Decision | None, service: Service | None) -> None:
        """Let the tasks know whose verdict or service changed; the service is None where there is no instance."""
        old = self.world.served.pop(name, None)
        verdicts = decision.verdicts if decision is not None else {}
        for task in old.verdicts.keys() - verdicts.keys() if old is not None else ():
            self.task_changed((name[0], task))  # one that means all instances may have others yet
        if decision is None:
            return
        served = Served(decision.verdicts, service or Service(name[1], applied=False, ready=False))
        self.world.served[name] = served
        all_changed = old is None or old.service != served.service
        for task, verdict in decision.verdicts.items():
            if all_changed or old is None or old.verdicts.get(task) != verdict:
                self.task_changed((name[0], task))

    def _live(self, instance: ApplicationInstance, applied: Applied) -> dict[ObjectKey, Object | None]:
        """The instance's objects, as watched."""
        keys = [(each.api_version, each.kind, each.name) for each in applied.objects]
        return {key: self.applier.live(instance.namespace, key) for key in keys}

    def _ready(self, instance: ApplicationInstance, objects: Mapping[ObjectKey, Object | None]) -> Aspect:
        missing = []
        for (_, kind, name), live in objects.items():
            problem = "does not exist" if live is None else not_ready(live)
            if problem is not None:
                missing.append(f"{kind} {name} {problem}")
        if not objects:
            return Aspect("Ready", False, "NotApplied", "nothing is applied yet")
        if instance.spec.suspended:
            return Aspect("Ready", False, "Suspended", "the instance is suspended")
        if missing:
            troubles = self.world.pods.troubles((instance.namespace, instance.name))
            reason = troubles[0].reason.value if troubles else "NotReady"
            return Aspect("Ready", False, reason, ": ".join(filter(None, ("; ".join(missing), _text(troubles)))))
        return Aspect("Ready", True, "Ready", "all workloads are ready")


def _text(troubles: Sequence[Trouble]) -> str:
    """The most telling troubles, as a condition says them."""
    more = f"; and {len(troubles) - _TROUBLES_SHOWN} more" if len(troubles) > _TROUBLES_SHOWN else ""
    return "; ".join(each.text for each in troubles[:_TROUBLES_SHOWN]) + more
