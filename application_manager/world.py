"""What the manager knows, in one place: the store, the index of claims, the Leases, and the compiled templates."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, TypeVar

from application_manager.apply import Applied
from application_manager.claimbook import ClaimBook
from application_manager.core.claims import Claim, InvalidTemplate, template_of_all
from application_manager.core.demand import Decision, decide, decide_for_all, has_baseline, written_deadline
from application_manager.core.leases import HealthyTime, LeaseBook, LeaseView
from application_manager.core.operations import Verdict
from application_manager.core.policy import KindKey, Policy
from application_manager.core.rendering import Renderer, RenderError
from application_manager.core.status import Service
from application_manager.podbook import PodBook
from application_manager.store import Name, Store
from wayside.api import API_VERSION, ApplicationInstance, ApplicationTask, ApplicationTemplate, Kind

Model = TypeVar("Model", bound=Kind)

TEMPLATE: Final[KindKey] = (API_VERSION, "ApplicationTemplate")
TASK: Final[KindKey] = (API_VERSION, "ApplicationTask")
INSTANCE: Final[KindKey] = (API_VERSION, "ApplicationInstance")
EVENT_RULE: Final[KindKey] = (API_VERSION, "EventRule")
DETECTOR: Final[KindKey] = (API_VERSION, "Detector")
OWN_KINDS: Final = (TEMPLATE, INSTANCE, TASK, DETECTOR, EVENT_RULE)
POD: Final[KindKey] = ("v1", "Pod")
LEASE: Final[KindKey] = ("coordination.k8s.io/v1", "Lease")


@dataclass(frozen=True, slots=True)
class Served:
    """What was last decided of an instance, and what it has given since."""

    verdicts: dict[str, Verdict]
    service: Service


@dataclass(frozen=True, slots=True)
class Record:
    """How the last work on an instance went.

    Attributes:
        uid: the instance's; a record of a namesake is worth nothing.
        decision: what was wanted.
        applied: what came of it.
        digest: of the rendering that was last applied in full.
    """

    uid: str
    decision: Decision
    applied: Applied
    digest: str | None


@dataclass
class World:
    """All that is known; only the event loop's thread touches it.

    Attributes:
        served: by instance; empty until it was reconciled for the first time.
        records: by instance; ahead of its status, and empty likewise.
        deadlines: by instance, its uid and the release time last decided; ahead of its status as well, since a status
            may be written long after what it says was decided.
    """

    policy: Policy
    store: Store = field(default_factory=lambda: Store(OWN_KINDS))
    claims: ClaimBook = field(default_factory=ClaimBook)
    pods: PodBook = field(default_factory=PodBook)
    leases: LeaseBook = field(default_factory=LeaseBook)
    healthy: HealthyTime = field(default_factory=HealthyTime)
    served: dict[Name, Served] = field(default_factory=dict)
    records: dict[Name, Record] = field(default_factory=dict)
    deadlines: dict[Name, tuple[str, float | None]] = field(default_factory=dict)
    _renderers: dict[Name, tuple[tuple[str, int], Renderer | RenderError]] = field(default_factory=dict)

    def template(self, name: Name) -> ApplicationTemplate | InvalidTemplate | None:
        """The template, also where it is not valid; None where there is none."""
        entry = self.store.get(TEMPLATE, name)
        if entry is None:
            return None
        return entry.model if isinstance(entry.model, ApplicationTemplate) else InvalidTemplate(name[1], entry.problem)

    def instance(self, name: Name) -> ApplicationInstance | None:
        """The instance, or None."""
        entry = self.store.get(INSTANCE, name)
        return entry.model if entry is not None and isinstance(entry.model, ApplicationInstance) else None

    def task(self, name: Name) -> ApplicationTask | None:
        """The task, or None where there is none, or none that is valid."""
        entry = self.store.get(TASK, name)
        return entry.model if entry is not None and isinstance(entry.model, ApplicationTask) else None

    def models(self, kind: KindKey, model: type[Model], namespace: str) -> list[Model]:
        """The objects of a kind in a namespace, as far as they are valid."""
        return [
            entry.model
            for name, entry in self.store.all(kind)
            if name[0] == namespace and isinstance(entry.model, model)
        ]

    def invalid(self, kind: KindKey, namespace: str) -> list[str]:
        """The names of the objects of a kind in a namespace that `models` leaves out."""
        return [name[1] for name, entry in self.store.all(kind) if name[0] == namespace and entry.model is None]

    def instances_of(self, template: Name) -> list[Name]:
        """The instances of a template."""
        return [
            name
            for name, entry in self.store.all(INSTANCE)
            if name[0] == template[0]
            and isinstance(entry.model, ApplicationInstance)
            and entry.model.spec.template == template[1]
        ]

    def decide(self, name: Name, now: float) -> Decision | None:
        """What should become of the instance as of `now`, in seconds since 1970; None: no one knows or wants it."""
        instance = self.instance(name)
        claims = self.claims.claims(name)
        if template_of_all(name[1]) is not None:
            return self._decide_for_all(name, claims, now)
        if instance is None and not claims and not has_baseline(self.template(name)):
            self.deadlines.pop(name, None)
            return None
        of = instance.spec.template if instance else claims[0].task.spec.template if claims else name[1]
        claims = self.claims.claims(name, of)
        holders = (each.task.spec.requester.holder for each in claims)
        decision = decide(
            name[1],
            of,
            template=self.template((name[0], of)),
            claims=claims,
            instance=instance,
            deadline=self._deadline(name, instance) if instance is not None else None,
            leases=self.lease_views(name[0], holders),
            now=now,
        )
        if instance is not None:
            self.deadlines[name] = (instance.metadata.uid, decision.release_time)
        return decision

    def _decide_for_all(self, name: Name, claims: list[Claim], now: float) -> Decision | None:
        """What is said of tasks that mean all instances of a template, by the name that stands for these."""
        if not claims:
            return None
        template = self.template((name[0], template_of_all(name[1]) or ""))
        holders = (each.task.spec.requester.holder for each in claims)
        leases = self.lease_views(name[0], holders)
        return decide_for_all(name[1], template=template, claims=claims, leases=leases, now=now)

    def meant(self, name: Name) -> set[Name]:
        """The instances that a name means, which may stand for all of a template; that name is among them."""
        of = template_of_all(name[1])
        if of is None:
            return {name}
        template = (name[0], of)
        own = {template} if has_baseline(self.template(template)) else set()
        return {name} | own | set(self.instances_of(template)) | self.claims.claimed_of(template)

    def _deadline(self, name: Name, instance: ApplicationInstance) -> float | None:
        uid, decided = self.deadlines.get(name, ("", None))
        return decided if uid == instance.metadata.uid else written_deadline(instance)

    def lease_views(self, namespace: str, holders: Iterable[str | None]) -> dict[str, LeaseView]:
        """The Leases of the holders, by holder."""
        at = self.healthy.elapsed
        return {each: self.leases.view((namespace, each), at) for each in set(holders) if each is not None}

    def renderer(self, template: ApplicationTemplate) -> Renderer:
        """The template, compiled once for each generation. Raises RenderError where it cannot be."""
        name = (template.namespace, template.name)
        version = (template.metadata.uid, template.metadata.generation)
        known = self._renderers.get(name)
        if known is None or known[0] != version:
            known = (version, self._compiled(template))
            self._renderers[name] = known
        if isinstance(known[1], RenderError):
            raise known[1]
        return known[1]

    def _compiled(self, template: ApplicationTemplate) -> Renderer | RenderError:
        try:
            return Renderer(template, self.policy)
        except RenderError as error:
            return error

    def forget_template(self, name: Name) -> None:
        """Drop the compiled template."""
        self._renderers.pop(name, None)
