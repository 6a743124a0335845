"""An incremental index of the claims of tasks on instances.

Without it, every change of a task would compute all claims again. Its content depends only on tasks and templates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from application_manager.cache.budget_index import BudgetIndex
from application_manager.cache.store import Entry, MembersByGroup
from application_manager.core.claims.claims import Claim, RefusalReason, TemplateState, all_instances, template_of_all
from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.demand.demand import claim_or_verdict, finished
from application_manager.core.holders.leases import HolderKey
from application_manager.core.holders.policies import TaskPolicy
from application_manager.core.objects.policy import Name
from wayside.api import ApplicationTask

Claims = Callable[[TemplateState, ApplicationTask], Claim | Verdict | None]
"""The claim of a task on a template, or its verdict; None while that is being computed."""


_ANY = TaskPolicy()


class ClaimIndex:
    """The claims of all tasks, and the verdicts of tasks that claim nothing.

    While a claim is being computed, the previous claim of the task stays in use, if there is one. Tasks that existed
    before this process became active may have instances: until their claims are known, their templates are
    unresolved, and the instances of these templates are not changed.

    Attributes:
        claim_of: computes the claim of a task.
        resolved: called with a template once all such claims are known.
        budget_changed: called with a task whose budget result changed because another task was added or has ended.
    """

    def __init__(self, claim: Claims = claim_or_verdict, policy: TaskPolicy = _ANY) -> None:
        self.claim_of = claim
        self.budget_changed: Callable[[Name], None] = lambda _: None
        self._policy = policy
        self._budgets = BudgetIndex(policy)
        self.resolved: Callable[[Name], None] = lambda _: None
        self._pending: dict[Name, set[Name]] = {}  # template → tasks
        self._unresolved: dict[Name, set[Name]] = {}  # of these, the tasks that existed at the start
        self._claims: dict[Name, Claim] = {}
        self._verdicts: dict[Name, Verdict] = {}
        self._by_instance: MembersByGroup[Name, Name, Claim] = MembersByGroup()
        self._by_template: MembersByGroup[Name, Name, ApplicationTask] = MembersByGroup()
        self._templates: dict[Name, Name] = {}  # task → template

    def note(self, name: Name, entry: Entry, template: TemplateState) -> set[Name]:
        """Note the state of a task; returns the instances that it claimed or claims, none while that is computed."""
        task = entry.model
        if isinstance(task, ApplicationTask) and finished(task) is None and self._policy.refusal(task) is None:
            affected = self._budgets.enter(task)
        else:
            affected = self._budgets.leave(name)
        touched = self._note(name, entry, template)
        for each in affected:
            self.budget_changed(each)
        return touched

    def _note(self, name: Name, entry: Entry, template: TemplateState) -> set[Name]:
        before = self._claims.get(name)
        task = entry.model
        claimed: Claim | Verdict | None = None
        if isinstance(task, ApplicationTask):
            claimed = self._beforehand(entry, task) or self.claim_of(template, task)
            if claimed is None:
                return self._wait(name, task, before)
        touched = self._drop(name)
        self._resolve(name, claimed)
        if not isinstance(task, ApplicationTask):
            problem = f"{entry.problem}: correct the task, or delete it and create another"
            self._verdicts[name] = Verdict(VerdictKind.REFUSED, RefusalReason.INVALID_TASK, problem)
            return touched
        self._file(name, task)
        if isinstance(claimed, Verdict):
            served = before is not None and template_of_all(before.instance) is None
            if claimed.kind is VerdictKind.FINISHED and before is not None and served:  # not yet in its status
                claimed = replace(claimed, instance=before.instance)
            self._verdicts[name] = claimed
            return touched
        assert claimed is not None  # noqa: S101  a pending claim has returned above
        instance = (name[0], claimed.instance)
        self._claims[name] = claimed
        self._by_instance.put(instance, name, claimed)
        return touched | {instance}

    def _beforehand(self, entry: Entry, task: ApplicationTask) -> Verdict | None:
        """The verdict that does not depend on the template, of a task that has ended or is refused; else None."""
        over = finished(task)
        if over is not None:
            return over
        if entry.problem:
            return Verdict(VerdictKind.REFUSED, RefusalReason.INVALID_PARAMETERS, entry.problem)
        return self._policy.refusal(task) or self._budgets.verdict((task.namespace, task.name))

    def _wait(self, name: Name, task: ApplicationTask, before: Claim | None) -> set[Name]:
        """Note that a task's claim is being computed: until then, the previous claim is kept."""
        touched = set() if before is not None and before.task.metadata.uid == task.metadata.uid else self._drop(name)
        self._file(name, task)
        self._pending.setdefault((name[0], task.spec.template_name), set()).add(name)
        return touched

    def _file(self, name: Name, task: ApplicationTask) -> None:
        of = (name[0], task.spec.template_name)
        self._templates[name] = of
        self._by_template.put(of, name, task)

    def _resolve(self, name: Name, found: Claim | Verdict | None) -> None:
        """Note the claim of a task; a claim that exceeds the limit of CPU time stays unknown."""
        still = isinstance(found, Verdict) and found.reason == RefusalReason.EXPRESSION_LIMIT
        for waiting in (self._pending,) if still else (self._pending, self._unresolved):
            for template in [each for each, names in waiting.items() if name in names]:
                waiting[template].discard(name)
                if not waiting[template]:
                    del waiting[template]
                    if waiting is self._unresolved:
                        self.resolved(template)

    def pending(self, template: Name) -> bool:
        """Whether claims of the template's tasks are being computed."""
        return template in self._pending

    def begin(self) -> None:
        """Note that all objects are listed: the claims that are being computed are of tasks that existed before."""
        self._unresolved = {template: set(names) for template, names in self._pending.items()}

    def unresolved(self, template: Name) -> bool:
        """Whether unknown claims of tasks that existed at the start may concern instances of the template."""
        return template in self._unresolved

    def forget(self, name: Name) -> set[Name]:
        """Forget a task; returns the instances that it claimed."""
        self._resolve(name, None)
        touched = self._drop(name)
        for each in self._budgets.leave(name):
            self.budget_changed(each)
        return touched

    def _drop(self, name: Name) -> set[Name]:
        self._verdicts.pop(name, None)
        of = self._templates.pop(name, None)
        if of is not None:
            self._by_template.drop(of, name)
        claimed = self._claims.pop(name, None)
        if claimed is None:
            return set()
        instance = (name[0], claimed.instance)
        self._by_instance.drop(instance, name)
        return {instance}

    def verdict(self, name: Name) -> Verdict | None:
        """The verdict of a task without a claim."""
        return self._verdicts.get(name)

    def claim(self, name: Name) -> Claim | None:
        """The claim of a task."""
        return self._claims.get(name)

    def claims(self, instance: Name, template: str | None = None) -> list[Claim]:
        """All claims on an instance; with its template, also the claims on all instances of the template."""
        claimed = list(self._by_instance.get(instance, {}).values())
        if template is not None:
            claimed += self._by_instance.get((instance[0], all_instances(template)), {}).values()
        return claimed

    def claimed_of(self, template: Name) -> set[Name]:
        """The claimed instances of a template, without the name that means all instances."""
        found = {claimed.instance for name in self.tasks_of(template) if (claimed := self._claims.get(name))}
        return {(template[0], each) for each in found if template_of_all(each) is None}

    def tasks_of(self, template: Name) -> list[Name]:
        """All tasks that name the template."""
        return list(self._by_template.get(template, {}))

    def holders(self) -> dict[HolderKey, set[Name]]:
        """The holders of claims, and the instances that they claim."""
        result: dict[HolderKey, set[Name]] = {}
        for (namespace, _), claimed in self._claims.items():
            holder = claimed.task.spec.requester.holder
            if holder is not None:
                result.setdefault((namespace, holder), set()).add((namespace, claimed.instance))
        return result

    def instances(self) -> Iterable[Name]:
        """The instances that are claimed."""
        return list(self._by_instance)
