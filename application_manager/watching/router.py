"""Routes events: each object enters the cache, and the router enqueues the objects that depend on it.

Watch events, responses to our own writes, and lists all come through here. A version that the cache already has is
ignored.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from application_manager.cache.cluster_cache import (
    DETECTOR,
    EVENT_RULE,
    INSTANCE,
    LEASE,
    POD,
    TASK,
    TEMPLATE,
    ClusterCache,
)
from application_manager.cache.store import Entry, kind_of, name_of
from application_manager.core.health.readiness import not_ready
from application_manager.core.objects.configuration import config_map_key
from application_manager.core.objects.ownership import controller_of, instance_of, object_key
from application_manager.core.objects.policy import Name
from application_manager.core.objects.suspension import pods_left
from application_manager.work.applying import Applier
from application_manager.work.validating import RuleKey
from wayside.api import ApplicationInstance
from wayside.api.applicationtemplate import ApplicationTemplateStatus
from wayside.kubernetes.leases import holder_of
from wayside.kubernetes.resources import Object

Enqueue = Callable[[Name], None]

_RULES = (DETECTOR, EVENT_RULE)

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Router:
    """Puts events into the cache and enqueues the objects that they concern; `rule` also enqueues Detectors."""

    cache: ClusterCache
    applier: Applier
    instance: Enqueue
    task: Enqueue
    template: Enqueue
    rule: Callable[[RuleKey], None]
    configuration: Enqueue

    def observe(self, raw: Object) -> None:
        """Put an object into the cache, and enqueue the objects that it concerns."""
        kind, name = kind_of(raw), name_of(raw)
        if kind == LEASE:
            self._lease(name, raw)
            return
        old = self.cache.store.get(kind, name)
        entry = self.cache.store.put(raw)
        if entry is None:
            if kind == TASK and name in self.cache.store.shed:
                self.task(name)
            return
        if old is not None and old.uid != entry.uid:
            self.applier.forget(old.raw)
        if kind == TASK:
            self.claimed(name)
        elif kind == TEMPLATE:
            self._template(name, old, entry)
        elif kind == INSTANCE:
            self._instance(name, old, entry)
        elif kind in _RULES:
            if old is None or _written(old) != _written(entry):
                self._rules(name[0])
        else:
            self._child(raw, old, entry)

    def deleted(self, raw: Object) -> None:
        """Remove a deleted object from the cache, and enqueue the objects that it concerns."""
        kind, name = kind_of(raw), name_of(raw)
        if kind == LEASE:
            self._lease(name, None)
            return
        entry = self.cache.store.remove(raw)
        if entry is None:
            return
        if kind == TASK:
            self._enqueue_all(self.cache.claims.forget(name))
        elif kind == TEMPLATE:
            self.cache.forget_template(name)
            self.cache.note_limits(name)
            self._claim_again(name)
            self._rules(name[0])
        elif kind == INSTANCE:
            self.enqueue_instance(name)
            self.configuration(name)
            if isinstance(entry.model, ApplicationInstance):
                self.template((name[0], entry.model.spec.template_name))
        elif kind in _RULES:
            self._rules(name[0])
        elif kind == POD and _belongs_to_workload(raw):
            if self.cache.pods.forget(raw):
                self._enqueue_owner(raw)
        else:
            self.cache.pods.forget(raw)
            self.applier.forget(raw)
            self._enqueue_owner(raw)
            self._enqueue_configuration(raw)

    def enqueue_everything(self) -> None:
        """Enqueue all objects."""
        for name, _ in self.cache.store.all(TEMPLATE):
            self.template(name)
        instances = {name for name, _ in self.cache.store.all(INSTANCE)}
        instances |= {name for name, _ in self.cache.store.all(TEMPLATE)}  # for their baselines
        self._enqueue_all(instances | set(self.cache.claims.instances()))
        for name, _ in self.cache.store.all(TASK):
            self.task(name)
        for kind in _RULES:
            for name, _ in self.cache.store.all(kind):
                self.rule((kind, name))

    def claimed(self, name: Name) -> None:
        """Enqueue a task whose claim may have changed, and the instances that it concerns."""
        self._enqueue_all(self.cache.note_task(name))
        self.task(name)

    def claims_resolved(self, template: Name) -> None:
        """Enqueue the instances of a template: the claims of all its tasks are known now."""
        for name in self.cache.instances_of(template):
            self.instance(name)

    def _template(self, name: Name, old: Entry | None, entry: Entry) -> None:
        status = ApplicationTemplateStatus.model_validate(entry.raw.get("status") or {})
        self.cache.overlap.note(name, status.manager, time.time())
        self.template(name)
        self.cache.note_limits(name)
        if old is None or old.uid != entry.uid or _written(old)[:2] != _written(entry)[:2]:
            self._claim_again(name)
            self._rules(name[0])

    def _claim_again(self, template: Name) -> None:
        """Determine the claims of all tasks of the template again, and enqueue its instances."""
        touched = {template, *self.cache.instances_of(template)}  # the baseline has the template's name
        touched |= self.cache.falling_back_to(template)
        for name in self.cache.claims.tasks_of(template):
            entry = self.cache.store.get(TASK, name)
            if entry is not None:
                touched |= self.cache.claims.note(name, entry, self.cache.template(template))
                self.task(name)
        self._enqueue_all(touched)

    def _instance(self, name: Name, old: Entry | None, entry: Entry) -> None:
        self.enqueue_instance(name)
        if (old is None or old.uid != entry.uid) and isinstance(entry.model, ApplicationInstance):
            self.template((name[0], entry.model.spec.template_name))

    def _child(self, raw: Object, old: Entry | None, entry: Entry) -> None:
        if kind_of(raw) == POD:
            if self.cache.pods.note(raw):
                self._enqueue_owner(entry.raw)
            if _belongs_to_workload(entry.raw):
                return  # the status of a workload reports that its pods are ready
        self.applier.note(entry.raw)
        if old is None or self._significance(old) != self._significance(entry) or self.applier.has_drifted(entry.uid):
            self._enqueue_owner(entry.raw)
        if old is None or old.raw.get("data") != entry.raw.get("data"):
            self._enqueue_configuration(entry.raw)

    def _significance(self, entry: Entry) -> tuple[str, bool, str | None, bool]:
        """The part of an object that matters to its instance; workloads change the rest of their status more often."""
        raw = entry.raw
        return entry.uid, "deletionTimestamp" in raw["metadata"], not_ready(raw), pods_left(raw) > 0

    def _enqueue_owner(self, raw: Object) -> None:
        owner = instance_of(raw)
        if owner is not None:
            self.instance(owner)

    def _enqueue_configuration(self, raw: Object) -> None:
        owner = instance_of(raw)
        if owner is not None and object_key(raw) == config_map_key(owner[1]):
            self.configuration(owner)

    def _lease(self, name: Name, raw: Object | None) -> None:
        holder = holder_of(name[1])
        if holder is None:
            return
        key = (name[0], holder)
        first, before = not self.cache.leases.seen(key), self.cache.leases.view(key)
        renewed = self.cache.leases.observe(key, raw, self.cache.healthy.elapsed)
        returns = renewed and (not before.renewed or before.unchanged >= before.duration)
        if returns:
            log.info("holder %s/%s renews its Lease again", *key)
        if first or returns:  # only now is its duration known
            self._enqueue_all(self.cache.claims.holders().get(key, ()))

    def _rules(self, namespace: str) -> None:
        """Enqueue the checks of all rules and detectors of a namespace: one may cause an error of the other.

        Findings of rules about templates may have changed too.
        """
        for kind in _RULES:
            for name, _ in self.cache.store.all(kind):
                if name[0] == namespace:
                    self.rule((kind, name))

    def enqueue_instance(self, name: Name) -> None:
        """Enqueue an instance, or all instances of a template if the name stands for these."""
        self._enqueue_all([name])

    def _enqueue_all(self, instances: Iterable[Name]) -> None:
        for name in self.cache.touch(instances):
            self.instance(name)


def _written(entry: Entry) -> tuple[object, ...]:
    """The part of a rule or detector that its authors write, or the error in it."""
    return entry.raw["spec"], entry.problem, entry.raw["metadata"].get("labels")


def _belongs_to_workload(pod: Object) -> bool:
    """Whether the pod belongs to a workload, and is not an object of the instance itself."""
    return controller_of(pod).get("kind") not in (None, ApplicationInstance.__name__)
