"""The cache of the cluster: the newest version of each object, with its indexes and the findings about templates."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import InitVar, dataclass, field, replace
from typing import Final, TypeVar

from application_manager.cache.claim_index import ClaimIndex
from application_manager.cache.fallback_index import FallbackIndex
from application_manager.cache.overlap_index import OverlapIndex
from application_manager.cache.place_index import PlaceIndex
from application_manager.cache.pod_index import PodIndex
from application_manager.cluster.apply import Applied
from application_manager.cluster.store import Name, Store
from application_manager.core.claims.claims import Claim, InvalidTemplate, template_of_all
from application_manager.core.claims.operations import Verdict
from application_manager.core.demand.deciding import decide, decide_for_all
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.demand import has_baseline
from application_manager.core.demand.fallback import Fallback, fallback_of, overdue
from application_manager.core.demand.lingering import written_deadline
from application_manager.core.demand.places import Candidate, Limits
from application_manager.core.demand.placing import candidate, limits, placed
from application_manager.core.findings.findings import Findings
from application_manager.core.holders.leases import HealthyTime, LeaseIndex, LeaseView
from application_manager.core.holders.policies import TaskPolicy
from application_manager.core.objects.policy import KindKey, Policy
from application_manager.core.statuses.status import Service
from wayside.api import API_VERSION, ApplicationInstance, ApplicationTask, ApplicationTemplate, Kind
from wayside.findings import ignored_by

Model = TypeVar("Model", bound=Kind)

TEMPLATE: Final[KindKey] = (API_VERSION, "ApplicationTemplate")
TASK: Final[KindKey] = (API_VERSION, "ApplicationTask")
INSTANCE: Final[KindKey] = (API_VERSION, "ApplicationInstance")
EVENT_RULE: Final[KindKey] = (API_VERSION, "EventRule")
DETECTOR: Final[KindKey] = (API_VERSION, "Detector")
OWN_KINDS: Final = (TEMPLATE, INSTANCE, TASK, DETECTOR, EVENT_RULE)
POD: Final[KindKey] = ("v1", "Pod")
LEASE: Final[KindKey] = ("coordination.k8s.io/v1", "Lease")


_Version = tuple[str, int, frozenset[str]]
"""Of a template: its uid, its generation, and the warnings that its annotation ignores."""


@dataclass(frozen=True, slots=True)
class Served:
    """What was last decided of an instance, and what it has given since."""

    verdicts: dict[str, Verdict]
    service: Service
    fallback: Fallback | None = None


@dataclass(frozen=True, slots=True)
class Record:
    """How the last work on an instance went.

    Attributes:
        uid: the instance's; a record of a namesake is worth nothing.
        decision: what was wanted.
        applied: what came of it.
        digest: of the rendering that was last applied in full.
        since: when the instance was first worked on by this process, in seconds since 1970.
    """

    uid: str
    decision: Decision
    applied: Applied
    digest: str | None
    since: float


@dataclass
class ClusterCache:
    """The objects of the cluster with their indexes. Only the thread of the event loop uses it.

    Attributes:
        served: by instance; empty until it was reconciled for the first time.
        records: by instance; ahead of its status, and empty likewise.
        deadlines: by instance, its uid and the release time last decided; ahead of its status as well, since a status
            may be written long after what it says was decided.
        limit: how many instances a namespace may have; None: any number.
        full: whether there is no memory for further tasks.
        tasks: what limits tasks; None: nothing.
        exceeded: by template, the instances whose rendering exceeds its limit, and the message.
    """

    policy: Policy
    limit: int | None = None
    full: InitVar[Callable[[], bool]] = lambda: False
    tasks: InitVar[TaskPolicy | None] = None
    store: Store = field(init=False)
    claims: ClaimIndex = field(init=False)
    pods: PodIndex = field(default_factory=PodIndex)
    leases: LeaseIndex = field(default_factory=LeaseIndex)
    healthy: HealthyTime = field(default_factory=HealthyTime)
    served: dict[Name, Served] = field(default_factory=dict)
    records: dict[Name, Record] = field(default_factory=dict)
    deadlines: dict[Name, tuple[str, float | None]] = field(default_factory=dict)
    turns: FallbackIndex = field(default_factory=FallbackIndex)
    overlap: OverlapIndex = field(default_factory=OverlapIndex)
    places: PlaceIndex = field(init=False)
    _limits: dict[str, dict[str, int]] = field(default_factory=dict)  # by namespace, of its templates
    exceeded: dict[Name, dict[Name, str]] = field(default_factory=dict)
    _findings: dict[Name, tuple[_Version, Findings]] = field(default_factory=dict)

    def __post_init__(self, full: Callable[[], bool], tasks: TaskPolicy | None) -> None:
        self.store = Store(OWN_KINDS, full)
        self.claims = ClaimIndex(policy=tasks or TaskPolicy())
        self.places = PlaceIndex(self._alone_and_candidate, self._known_instances)

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
        if template_of_all(name[1]) is not None:
            return self._decide_for_all(name, self.claims.claims(name), now)
        bounds = Limits(self._limits.get(name[0], {}), self.limit)
        place = self.places.place(name, bounds, now)
        decision = self._alone(name, now)
        for each in self.turns.turn(name, decision.fallback if decision is not None else None):
            self.places.touch(each)
            self.places.changed(each)
        if decision is not None:
            decision = placed(decision, place, exists=self.instance(name) is not None, now=now)
        return decision

    def note_limits(self, template: Name) -> None:
        """Note how many instances a template may have now, and what it falls back to, should it be there."""
        found = self.template(template)
        self.turns.note_template(template, fallback_of(found))
        own = limits([found], None).templates if found is not None else {}
        others = {name: count for name, count in self._limits.get(template[0], {}).items() if name != template[1]}
        self._limits[template[0]] = {**others, **own}

    def _borrowed(self, name: Name, template: str, now: float) -> list[Claim]:
        """The claims on an instance by tasks of others that are not ready."""
        found: list[Claim] = []
        for of in self.turns.falling_to((name[0], template)):
            for each in self.instances_of(of):
                instance = self.instance(each)
                if instance is None or not overdue(instance, self.template(of), now)[0]:
                    continue
                decision = self._own(each, of[1], self.claims.claims(each, of[1]), now)
                claims = decision.fallback.claims if decision.fallback is not None else ()
                found += [claimed for claimed in claims if claimed.instance == name[1]]
        return found

    def falling_back_to(self, template: Name) -> set[Name]:
        """The instances whose tasks turn to this template when they are not ready."""
        return {each for name in self.turns.falling_to(template) for each in self.instances_of(name)}

    def _template_of(self, name: Name, instance: ApplicationInstance | None, claims: list[Claim]) -> str:
        if instance is not None:
            return instance.spec.template
        return claims[0].template if claims else self.turns.template_of(name) or name[1]

    def _known_instances(self, namespace: str) -> set[Name]:
        """The instances of a namespace that there are, or that are demanded."""
        known = {name for name, _ in self.store.all(INSTANCE)} | {name for name, _ in self.store.all(TEMPLATE)}
        known |= {name for name in self.claims.instances() if template_of_all(name[1]) is None}
        return {name for name in known if name[0] == namespace}

    def _alone_and_candidate(self, name: Name, now: float) -> tuple[Decision, Candidate | None] | None:
        decision = self._alone(name, now)
        if decision is None:
            return None
        template = self.template((name[0], decision.template))
        being_made = name in self.places.being_made
        return decision, candidate(decision, self.instance(name), template, being_made=being_made)

    def _alone(self, name: Name, now: float) -> Decision | None:
        """What should become of the instance were there no limits."""
        instance, named = self.instance(name), self.claims.claims(name)
        of = self._template_of(name, instance, named)
        own, borrowed = self.claims.claims(name, of), self._borrowed(name, of, now)
        if instance is None and not named and not borrowed and not has_baseline(self.template(name)):
            self.deadlines.pop(name, None)
            return None
        decision = self._own(name, of, [*own, *borrowed], now)
        if borrowed and decision.overdue:  # what it serves for others it does not hand on
            decision = replace(decision, fallback=self._own(name, of, own, now).fallback)
        if instance is not None:
            self.deadlines[name] = (instance.metadata.uid, decision.release_time)
        return decision

    def _own(self, name: Name, of: str, claims: list[Claim], now: float) -> Decision:
        instance, template = self.instance(name), self.template((name[0], of))
        holders = (each.task.spec.requester.holder for each in claims)
        other = fallback_of(template)
        return decide(
            name[1],
            of,
            template=template,
            claims=claims,
            instance=instance,
            deadline=self._deadline(name, instance) if instance is not None else None,
            leases=self.lease_views(name[0], holders),
            now=now,
            other=self.template((name[0], other)) if other is not None else None,
        )

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
        demanded = own | self.claims.claimed_of(template) | self.turns.instances_of(template)
        return {name} | demanded | set(self.instances_of(template))

    def _deadline(self, name: Name, instance: ApplicationInstance) -> float | None:
        uid, decided = self.deadlines.get(name, ("", None))
        return decided if uid == instance.metadata.uid else written_deadline(instance)

    def lease_views(self, namespace: str, holders: Iterable[str | None]) -> dict[str, LeaseView]:
        """The Leases of the holders, by holder."""
        at = self.healthy.elapsed
        return {each: self.leases.view((namespace, each), at) for each in set(holders) if each is not None}

    def known_findings(self, template: ApplicationTemplate) -> Findings | None:
        """What was noted of this generation of the template; None where nothing was yet."""
        known = self._findings.get((template.namespace, template.name))
        return known[1] if known is not None and known[0] == _version(template) else None

    def note_findings(self, template: ApplicationTemplate, findings: Findings) -> None:
        """Note what is wrong with this generation of the template."""
        self._findings[template.namespace, template.name] = (_version(template), findings)

    def forget_work(self) -> None:
        """Drop what was decided and done here: another manager has acted since, and the statuses say what it did."""
        self.served.clear()
        self.records.clear()
        self.deadlines.clear()
        self.places.forget()

    def forget_template(self, name: Name) -> None:
        """Drop what was found of a template."""
        self._findings.pop(name, None)
        self.exceeded.pop(name, None)
        self.overlap.forget(name)


def _version(template: ApplicationTemplate) -> _Version:
    metadata = template.metadata
    return metadata.uid, metadata.generation, ignored_by(metadata.annotations)
