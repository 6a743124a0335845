"""The cache of the cluster: the newest version of each object, with its indexes and the findings about templates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import InitVar, dataclass, field, replace
from typing import Final, TypeVar

from application_manager.cache.claim_index import ClaimIndex
from application_manager.cache.decision_index import FallbackIndex, PlaceIndex
from application_manager.cache.overlap_index import OverlapIndex
from application_manager.cache.pod_index import PodIndex
from application_manager.cache.store import MembersByGroup, Store
from application_manager.core.claims.claims import Claim, InvalidTemplate, TemplateState, template_of_all
from application_manager.core.demand.deciding import (
    Decided,
    decide,
    decide_without_limits,
    fallback_claims,
    has_baseline,
    request,
)
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.fallback import Fallback, fallback_of
from application_manager.core.demand.lingering import written_deadline
from application_manager.core.demand.places import Limits, Placement
from application_manager.core.demand.placing import limits
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.rulefindings import RuleContext
from application_manager.core.holders.leases import HealthyTime, LeaseIndex, LeaseView
from application_manager.core.holders.policies import TaskPolicy
from application_manager.core.objects.ownership import ApplyResult
from application_manager.core.objects.policy import KindKey, Name, Policy
from application_manager.core.objects.trimming import without_objects
from application_manager.core.statuses.status import InstanceProgress
from wayside.api import (
    API_VERSION,
    ApplicationInstance,
    ApplicationTask,
    ApplicationTemplate,
    Detector,
    EventRule,
    Kind,
)
from wayside.findings import ignored_by
from wayside.kubernetes.resources import Resource
from wayside.rules import depends

Model = TypeVar("Model", bound=Kind)

TEMPLATE: Final[KindKey] = (API_VERSION, "ApplicationTemplate")
TASK: Final[KindKey] = (API_VERSION, "ApplicationTask")
INSTANCE: Final[KindKey] = (API_VERSION, "ApplicationInstance")
EVENT_RULE: Final[KindKey] = (API_VERSION, "EventRule")
DETECTOR: Final[KindKey] = (API_VERSION, "Detector")
TEMPLATES: Final = Resource(*TEMPLATE, ApplicationTemplate.plural)
TASKS: Final = Resource(*TASK, ApplicationTask.plural)
INSTANCES: Final = Resource(*INSTANCE, ApplicationInstance.plural)
EVENT_RULES: Final = Resource(*EVENT_RULE, EventRule.plural)
DETECTORS: Final = Resource(*DETECTOR, Detector.plural)
OWN: Final = {TEMPLATE: TEMPLATES, INSTANCE: INSTANCES, TASK: TASKS, DETECTOR: DETECTORS, EVENT_RULE: EVENT_RULES}
"""Our own kinds and their resources, in the order of dependencies."""

POD: Final[KindKey] = ("v1", "Pod")
LEASE: Final[KindKey] = ("coordination.k8s.io/v1", "Lease")


_Version = tuple[str, int, frozenset[str]]
"""A template's uid, its generation, and the warnings that its annotation ignores."""


@dataclass(frozen=True, slots=True)
class LastDecision:
    """The last decision about an instance, and the progress since."""

    decision: Decision
    progress: InstanceProgress


@dataclass(frozen=True, slots=True)
class WorkRecord:
    """The result of the last work on an instance.

    Attributes:
        uid: of the instance; the record of another instance with the same name is ignored.
        generation: of the instance at that time.
        digest: of the last completely applied rendering.
        since: when this process first worked on the instance, in seconds since 1970.
    """

    uid: str
    generation: int
    decision: Decision
    applied: ApplyResult
    digest: str | None
    since: float


@dataclass
class ClusterCache:
    """The objects of the cluster with their indexes. Only the thread of the event loop uses it.

    Attributes:
        last_decisions: by instance; without an entry until it was reconciled for the first time.
        records: by instance; newer than its status; without an entry until then as well.
        deadlines: by instance, its uid and the last decided release time; newer than its status, which may be written
            long after the decision.
        limit: the maximum number of instances in a namespace; None: no limit.
        full: whether memory is short, so that no new tasks are accepted.
        tasks: the limits of tasks; None: no limits.
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
    last_decisions: dict[Name, LastDecision] = field(default_factory=dict)
    records: dict[Name, WorkRecord] = field(default_factory=dict)
    deadlines: dict[Name, tuple[str, float | None]] = field(default_factory=dict)
    fallbacks: FallbackIndex = field(default_factory=FallbackIndex)
    overlap: OverlapIndex = field(default_factory=OverlapIndex)
    places: PlaceIndex = field(default_factory=PlaceIndex)
    _limits: dict[str, dict[str, int]] = field(default_factory=dict)  # by namespace, of its templates
    exceeded: MembersByGroup[Name, Name, str] = field(default_factory=MembersByGroup)
    _findings: dict[Name, tuple[_Version, Findings]] = field(default_factory=dict)

    def __post_init__(self, full: Callable[[], bool], tasks: TaskPolicy | None) -> None:
        self.store = Store(OWN, full)
        self.claims = ClaimIndex(policy=tasks or TaskPolicy())

    def template(self, name: Name) -> TemplateState:
        """The template, even if it is not valid; None if there is none."""
        entry = self.store.get(TEMPLATE, name)
        if entry is None:
            return None
        return entry.model if isinstance(entry.model, ApplicationTemplate) else InvalidTemplate(name[1], entry.problem)

    def instance(self, name: Name) -> ApplicationInstance | None:
        """The instance; None if there is no valid one. Tasks and Detectors likewise."""
        return self._model(INSTANCE, ApplicationInstance, name)

    def task(self, name: Name) -> ApplicationTask | None:
        """The task."""
        return self._model(TASK, ApplicationTask, name)

    def detector(self, name: Name) -> Detector | None:
        """The Detector."""
        return self._model(DETECTOR, Detector, name)

    def _model(self, kind: KindKey, model: type[Model], name: Name) -> Model | None:
        entry = self.store.get(kind, name)
        return entry.model if entry is not None and isinstance(entry.model, model) else None

    def models(self, kind: KindKey, model: type[Model], namespace: str) -> list[Model]:
        """The valid objects of a kind in a namespace."""
        return [
            entry.model
            for name, entry in self.store.all(kind)
            if name[0] == namespace and isinstance(entry.model, model)
        ]

    def invalid(self, kind: KindKey, namespace: str) -> list[str]:
        """The names of the invalid objects of a kind in a namespace, which `models` leaves out."""
        return [name[1] for name, entry in self.store.all(kind) if name[0] == namespace and entry.model is None]

    def instances_of(self, template: Name) -> list[Name]:
        """The instances of a template."""
        found = self.models(INSTANCE, ApplicationInstance, template[0])
        return [(each.namespace, each.name) for each in found if each.spec.template_name == template[1]]

    def record_of(self, instance: ApplicationInstance) -> WorkRecord | None:
        """The result of the last work on the instance; None if this process has not worked on it."""
        record = self.records.get((instance.namespace, instance.name))
        return record if record is not None and record.uid == instance.metadata.uid else None

    def decide(self, name: Name, now: float) -> tuple[Decided, set[Name]]:
        """The decision about the instance at `now`, in seconds since 1970, and the other instances to enqueue.

        Their decisions depend on this one, so they are decided again.
        """
        decided = decide(name[1], _NamespaceIndexes(self, name[0]), now)
        affected = self.fallbacks.affected(name, _fallback(decided))
        if decided.placement is not None:
            affected |= decided.placement.changed_since(self.places.placement(name[0]))
        return decided, {(name[0], each) for each in affected - {name[1]}}

    def note(self, name: Name, decided: Decided) -> None:
        """Note a decision in the indexes that further decisions read."""
        for claim in self.claims.claims(name):
            if (holder := claim.task.spec.requester.holder) is not None:
                self.leases.expect((name[0], holder), self.healthy.elapsed)
        if template_of_all(name[1]) is not None:
            return
        instance, fallback = self.instance(name), _fallback(decided)
        if decided.unlimited is None:
            self.deadlines.pop(name, None)
        elif instance is not None:
            self.deadlines[name] = (instance.metadata.uid, decided.unlimited.release_time)
        self.places.note(name[0], decided.placement)
        for each in self.fallbacks.affected(name, fallback):
            self.places.touch((name[0], each))
        self.fallbacks.note(name, fallback)

    def note_task(self, name: Name) -> set[Name]:
        """Compute the claim of a task again; returns the previous and new instances that it claims, if that changed.

        A task of which only the status changed, mostly by our own writes, concerns no instance.
        """
        entry, before = self.store.get(TASK, name), self.claims.claim(name)
        if entry is None:
            return set()
        touched = self.claims.note(name, entry, self.template((name[0], entry.raw["spec"].get("templateName", ""))))
        after = self.claims.claim(name)
        if before is None or after is None or before.task.metadata.uid != entry.uid:
            return touched
        same = before.task.spec == after.task.spec and replace(before, task=after.task) == after
        return set() if same else touched

    def touch(self, instances: Iterable[Name]) -> set[Name]:
        """Note a change of the instances; returns the instances to decide again.

        A name that stands for all instances of a template is replaced by these.
        """
        found = {each for name in instances for each in self.expand(name)}
        for each in found:
            self.places.touch(each)
        return found

    def has_unresolved_claims(self, instance: Name) -> bool:
        """Whether unknown claims of tasks that existed at the start may concern the instance."""
        known = self.instance(instance)
        return known is not None and self.claims.unresolved((instance[0], known.spec.template_name))

    def note_limits(self, template: Name) -> None:
        """Note the template's maximum number of instances, and its fallback, if any."""
        found = self.template(template)
        self.fallbacks.note_template(template, fallback_of(found))
        own = limits([found], None).templates if found is not None else {}
        others = {name: count for name, count in self._limits.get(template[0], {}).items() if name != template[1]}
        self._limits[template[0]] = {**others, **own}

    def falling_back_to(self, template: Name) -> set[Name]:
        """The instances whose tasks use this template as the fallback while they are not ready."""
        return {each for name in self.fallbacks.falling_to(template) for each in self.instances_of(name)}

    def known_instances(self, namespace: str) -> set[str]:
        """The names of a namespace's instances that exist, or may be demanded."""
        known = {name for name, _ in self.store.all(INSTANCE)} | {name for name, _ in self.store.all(TEMPLATE)}
        known |= {name for name in self.claims.instances() if template_of_all(name[1]) is None}
        return {name for of, name in known if of == namespace}

    def limits(self, namespace: str) -> Limits:
        """The maximum numbers of instances in a namespace."""
        return Limits(self._limits.get(namespace, {}), self.limit)

    def expand(self, name: Name) -> set[Name]:
        """The name itself, and if it stands for all instances of a template, also these."""
        of = template_of_all(name[1])
        if of is None:
            return {name}
        template = (name[0], of)
        own = {template} if has_baseline(self.template(template)) else set()
        demanded = own | self.claims.claimed_of(template) | self.fallbacks.instances_of(template)
        return {name} | demanded | set(self.instances_of(template))

    def lease_views(self, namespace: str, holders: Iterable[str | None]) -> dict[str, LeaseView]:
        """The Leases of the holders, by holder."""
        return {each: self.leases.view((namespace, each)) for each in set(holders) if each is not None}

    def known_findings(self, template: ApplicationTemplate) -> Findings | None:
        """The findings about this generation of the template; None if it was not checked yet."""
        known = self._findings.get((template.namespace, template.name))
        return known[1] if known is not None and known[0] == _version(template) else None

    def note_findings(self, template: ApplicationTemplate, findings: Findings) -> None:
        """Note the findings about this generation of the template."""
        self._findings[template.namespace, template.name] = (_version(template), findings)

    def forget_work(self) -> None:
        """Forget the decisions and results of this manager: another one has acted since, as the statuses show."""
        self.last_decisions.clear()
        self.records.clear()
        self.deadlines.clear()
        self.places.forget()

    def forget_template(self, name: Name) -> None:
        """Forget the findings about a template."""
        self._findings.pop(name, None)
        self.exceeded.pop(name, None)
        self.overlap.forget(name)


@dataclass(frozen=True, slots=True)
class _NamespaceIndexes:
    """The indexes of one namespace, as decisions read them."""

    cache: ClusterCache
    namespace: str

    def template(self, name: str) -> TemplateState:
        return self.cache.template((self.namespace, name))

    def instance(self, name: str) -> ApplicationInstance | None:
        return self.cache.instance((self.namespace, name))

    def claims(self, instance: str, template: str | None = None) -> list[Claim]:
        return self.cache.claims.claims((self.namespace, instance), template)

    def deadline(self, instance: ApplicationInstance) -> float | None:
        uid, decided = self.cache.deadlines.get((self.namespace, instance.name), ("", None))
        return decided if uid == instance.metadata.uid else written_deadline(instance)

    def leases(self, claims: Iterable[Claim]) -> Mapping[str, LeaseView]:
        return self.cache.lease_views(self.namespace, (each.task.spec.requester.holder for each in claims))

    def fallback_templates(self) -> Iterable[str]:
        return self.cache.fallbacks.targets(self.namespace)

    def fallbacks(self, template: str, now: float) -> Iterable[Fallback]:
        for name in self.cache.falling_back_to((self.namespace, template)):
            instance = self.cache.instance(name)
            fallback = fallback_claims(instance, self, now) if instance is not None else None
            if fallback is not None:
                yield fallback

    def placement(self, name: str, unlimited: Decision | None, now: float) -> Placement | None:
        limits, places = self.cache.limits(self.namespace), self.cache.places
        if not limits:
            return None
        known = places.placement(self.namespace)
        names = places.stale(known, self.namespace, now) if known else self.cache.known_instances(self.namespace)
        decisions = {each: decide_without_limits(each, self, now) for each in names - {name}} | {name: unlimited}
        requests = {
            each: request(each, decision, self, being_created=(self.namespace, each) in places.being_created)
            for each, decision in decisions.items()
        }
        return (known or Placement(limits)).updated(requests, limits, now)


def _fallback(decided: Decided) -> Fallback | None:
    return decided.unlimited.fallback if decided.unlimited is not None else None


def _version(template: ApplicationTemplate) -> _Version:
    metadata = template.metadata
    return metadata.uid, metadata.generation, ignored_by(metadata.annotations)


def rule_context(cache: ClusterCache, rule: EventRule) -> RuleContext:
    """The objects that matter to the rule: other rules if it names any, templates if it deploys any."""
    namespace = rule.namespace
    deploys = any(each.deploy is not None for each in rule.spec.actions)
    templates = cache.models(TEMPLATE, ApplicationTemplate, namespace) if deploys else []
    return RuleContext(
        detectors=cache.models(DETECTOR, Detector, namespace),
        invalid_detectors=cache.invalid(DETECTOR, namespace),
        rules=cache.models(EVENT_RULE, EventRule, namespace) if depends(rule) else [],
        templates=[without_objects(each) for each in templates],
        invalid_templates=cache.invalid(TEMPLATE, namespace) if deploys else [],
    )
