"""Reconciling one instance: decide, apply the instance, apply its objects, say how it is. All the way in one go.

Nothing here waits for our own watch events: each answer of the API server enters the store, and the next step goes on
from it. What fails is tried again as a whole, from what is known then.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from application_manager import conditions
from application_manager.apply import Applied, Applier
from application_manager.claims import InvalidTemplate
from application_manager.client import ApiError, Client, Object, Resource
from application_manager.conditions import Aspect
from application_manager.demand import LINGER_ANNOTATION, Decision, decide, is_managed, linger_of
from application_manager.readiness import not_ready
from application_manager.recorder import Reason, Recorder
from application_manager.rendering import RenderError, Rendering
from application_manager.status import Service, demands, difference, instance_status
from application_manager.store import Name
from application_manager.world import Served, World
from wayside.api import API_VERSION, ApplicationInstance, ApplicationTemplate
from wayside.api.applicationinstance import ApplicationInstanceSpec, ApplicationInstanceStatus, ObjectReference
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL, Metadata

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class InstanceWork:
    """Reconciles instances.

    Attributes:
        instances: where ApplicationInstances live.
        tasks: where ApplicationTasks live.
        again: asks for an instance at a time, in seconds since 1970.
        task_changed: asks for a task's status to be looked at.
        observe: takes an object that was read.
    """

    world: World
    client: Client
    applier: Applier
    recorder: Recorder
    instances: Resource
    tasks: Resource
    again: Callable[[Name, float], None]
    task_changed: Callable[[Name], None]
    observe: Callable[[Object], None]

    async def reconcile(self, name: Name) -> None:
        """Make the cluster match what is demanded of this instance.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        try:
            await self._reconcile(name)
        except ApiError as error:
            if error.terminating:
                log.debug("instance %s/%s: its namespace is going", *name)
                return
            if error.code in (404, 409):  # the instance changed under us: the watch brings the news, and we come back
                log.debug("instance %s/%s: %s", *name, error)
            raise

    async def _reconcile(self, name: Name) -> None:
        now = time.time()
        instance = self.world.instance(name)
        decision = self._decide(name, now)
        if decision is None or (instance is None and not decision.wanted):
            self._tell(name, decision, None)
            return
        if instance is not None and instance.metadata.deletion_timestamp is not None:
            return  # it is waited for: its deletion brings us back
        if decision.next_change is not None:
            self.again(name, decision.next_change)
        if decision.release_time is not None and decision.release_time <= now:
            if await self._released(name):
                return
            now, decision = time.time(), self._decide(name, time.time()) or decision
        await self._run(name, decision, instance, now)

    def _decide(self, name: Name, now: float) -> Decision | None:
        instance = self.world.instance(name)
        claims = self.world.claims.claims(name)
        if instance is None and not claims:
            return None
        of = instance.spec.template if instance is not None else claims[0].task.spec.template
        holders = (each.task.spec.requester.holder for each in claims)
        return decide(
            name[1],
            of,
            template=self.world.template((name[0], of)),
            claims=claims,
            instance=instance,
            leases=self.world.lease_views(name[0], holders),
            now=now,
        )

    async def _run(self, name: Name, decision: Decision, existing: ApplicationInstance | None, now: float) -> None:
        draft = self._draft(name, decision, existing)
        rendering = self._render(draft)
        manifest = self._manifest(draft, existing)
        looked: dict[tuple[str, str, str], Object | None] = {}
        if manifest is not None and isinstance(rendering, Rendering):
            # Both at once: the objects to apply are known before the instance has a uid.
            raw, looked = await asyncio.gather(
                self.client.apply(self.instances, manifest),
                self.applier.look(name[0], self.applier.pending(draft, rendering)),
            )
            self.observe(raw)
        elif manifest is not None:
            self.observe(await self.client.apply(self.instances, manifest))
        instance = self.world.instance(name)
        if instance is None or instance.metadata.deletion_timestamp is not None:
            return  # deleted by somebody meanwhile: its event brings us back
        if not isinstance(rendering, Rendering):
            await self._say(name, decision, instance, Applied(rendering, _objects(instance), complete=False), None, now)
            return
        pending = self.applier.pending(instance, rendering)
        if not pending and instance.status is not None:
            kept = conditions.find(instance.status.conditions, "Applied")
            if kept is not None and kept.status == "True":
                aspect = Aspect("Applied", True, kept.reason, kept.message)
                applied = Applied(aspect, _objects(instance), complete=True)
                await self._say(name, decision, instance, applied, rendering, now)
                return
        if manifest is None:
            looked = await self.applier.look(name[0], pending)

        async def record(objects: tuple[ObjectReference, ...]) -> None:
            status = {"objects": [each.to_json() for each in objects], "demands": demands(decision).to_json()}
            self.observe(await self._patch(instance, status))

        try:
            applied = await self.applier.apply(instance, rendering, pending, looked, record)
        except ApiError as error:
            if error.terminating or error.permanent:
                raise
            now_known = self.world.instance(name) or instance
            aspect = Aspect("Applied", False, "Retrying", f"the API server failed and is asked again: {error.message}")
            failed = Applied(aspect, _objects(now_known), complete=False)
            await self._say(name, decision, now_known, failed, rendering, now)
            raise
        await self._say(name, decision, self.world.instance(name) or instance, applied, rendering, now)
        if applied.aspect.reason == "Waiting":
            self.again(name, time.time() + 1)

    def _draft(self, name: Name, decision: Decision, existing: ApplicationInstance | None) -> ApplicationInstance:
        """The instance as it should be; without a uid where it does not exist yet."""
        if existing is not None and decision.parameters is None:
            return existing
        spec = ApplicationInstanceSpec(
            template=decision.template, key=decision.key, parameters=dict(decision.parameters or {})
        )
        if existing is not None:
            return existing.model_copy(update={"spec": spec})
        return ApplicationInstance(metadata=Metadata(name=name[1], namespace=name[0]), spec=spec)

    def _render(self, draft: ApplicationInstance) -> Rendering | Aspect:
        """The instance's objects, or why it has none as the condition Applied says it."""
        of = draft.spec.template
        template = self.world.template((draft.namespace, of))
        if template is None:
            return Aspect(
                "Applied",
                False,
                "TemplateNotFound",
                f"spec.template: there is no ApplicationTemplate {of!r} in namespace {draft.namespace}: create it; "
                "until then what runs stays as it is",
            )
        if isinstance(template, InvalidTemplate):
            return Aspect("Applied", False, "TemplateInvalid", f"ApplicationTemplate {of}: {template.problem}")
        try:
            return self.world.renderer(template).render(draft)
        except RenderError as error:
            return Aspect("Applied", False, "RenderFailed", f"ApplicationTemplate {of}: {error}")

    def _manifest(self, draft: ApplicationInstance, existing: ApplicationInstance | None) -> Object | None:
        """What to apply so that the instance becomes the draft; None if it is so already, or is a person's."""
        template = self.world.template((draft.namespace, draft.spec.template))
        if existing is not None:
            if not is_managed(existing):
                return None
            same_linger = not isinstance(template, ApplicationTemplate) or (
                existing.metadata.annotations.get(LINGER_ANNOTATION) == template.spec.lifecycle.linger
            )
            if same_linger and existing.spec == draft.spec:
                return None
        usable = template if isinstance(template, ApplicationTemplate) else None
        return {
            "apiVersion": API_VERSION,
            "kind": draft.kind,
            "metadata": {
                "name": draft.name,
                "namespace": draft.namespace,
                "labels": {MANAGED_BY_LABEL: MANAGED_BY},
                "annotations": {LINGER_ANNOTATION: str(linger_of(draft, usable))},
                **({"uid": existing.metadata.uid} if existing else {}),
            },
            "spec": draft.spec.to_json(),
        }

    async def _say(
        self,
        name: Name,
        decision: Decision,
        instance: ApplicationInstance,
        applied: Applied,
        rendering: Rendering | None,
        now: float,
    ) -> None:
        old = instance.status or ApplicationInstanceStatus()
        spec_hash = rendering.digest if applied.complete and rendering is not None else old.spec_hash
        ready = self._ready(instance, applied)
        new = instance_status(instance, decision, applied.aspect, ready, applied.objects, spec_hash, now)
        patch = difference(old.to_json() if instance.status else {}, new.to_json())
        if patch:
            self.observe(await self._patch(instance, patch))
            self.recorder.transitions(instance, old.conditions, new.conditions, now)
            if old.release_time is None and new.release_time is not None:
                note = f"no demand is left; it is released at {new.release_time} unless a new one comes"
                self.recorder.say(instance, Reason.LINGERING, note, now)
        self._tell(name, decision, Service(name[1], applied.aspect.holds, ready.holds, _why_not(applied.aspect, ready)))

    def _ready(self, instance: ApplicationInstance, applied: Applied) -> Aspect:
        missing = []
        for each in applied.objects:
            live = self.applier.live(instance.namespace, (each.api_version, each.kind, each.name))
            problem = "does not exist" if live is None else not_ready(live)
            if problem is not None:
                missing.append(f"{each.kind} {each.name} {problem}")
        if not applied.objects:
            return Aspect("Ready", False, "NotApplied", "nothing is applied yet")
        if missing:
            return Aspect("Ready", False, "NotReady", "; ".join(missing))
        return Aspect("Ready", True, "Ready", "all workloads are ready")

    def _tell(self, name: Name, decision: Decision | None, service: Service | None) -> None:
        """Let the tasks know whose verdict or service changed."""
        old = self.world.served.pop(name, None)
        if decision is None:
            return
        served = Served(decision.verdicts, service or Service(name[1], applied=False, ready=False))
        self.world.served[name] = served
        all_changed = old is None or old.service != served.service
        for task, verdict in decision.verdicts.items():
            if all_changed or old is None or old.verdicts.get(task) != verdict:
                self.task_changed((name[0], task))

    async def _released(self, name: Name) -> bool:
        """Delete the instance, if a fresh look at the tasks agrees that nobody wants it. Returns whether it is gone."""
        instance = self.world.instance(name)
        if instance is None:
            return True
        # What we know may have holes (a watch that broke, for one): nothing is stopped without looking.
        fields = f"spec.template={instance.spec.template}"
        listed, _ = await self.client.list(self.tasks, name[0], fields=fields)
        for raw in listed:
            self.observe(raw)
        decision = self._decide(name, time.time())
        if decision is None or decision.release_time is None or decision.release_time > time.time():
            return False
        await self.client.delete(self.instances, name[0], name[1], instance.metadata.uid)
        self.recorder.say(instance, Reason.RELEASED, "no demand came within its linger", time.time())
        log.info("instance %s/%s: released", *name)
        return True

    async def _patch(self, instance: ApplicationInstance, status: dict[str, Any]) -> Object:
        return await self.client.patch_status(
            self.instances, instance.namespace, instance.name, instance.metadata.uid, status
        )


def _objects(instance: ApplicationInstance) -> tuple[ObjectReference, ...]:
    return tuple(instance.status.objects) if instance.status else ()


def _why_not(applied: Aspect, ready: Aspect) -> str:
    return applied.message if not applied.holds else "" if ready.holds else ready.message
