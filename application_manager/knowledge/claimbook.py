"""Which task claims which instance: an index, kept up to date task by task.

It saves asking every task again whenever one changes. What it holds follows from tasks and templates alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from application_manager.cluster.store import Entry, Name
from application_manager.core.claims.claims import Claim, InvalidTemplate, Refused, all_instances, template_of_all
from application_manager.core.claims.operations import Standing, Verdict
from application_manager.core.demand.demand import claim_or_verdict
from application_manager.core.holders.leases import HolderKey
from wayside.api import ApplicationTask, ApplicationTemplate


class ClaimBook:
    """Claims of all tasks, and the verdicts of those that claim nothing."""

    def __init__(self) -> None:
        self._claims: dict[Name, Claim] = {}
        self._verdicts: dict[Name, Verdict] = {}
        self._by_instance: dict[Name, dict[Name, Claim]] = {}
        self._by_template: dict[Name, dict[Name, ApplicationTask]] = {}
        self._templates: dict[Name, Name] = {}  # task → template

    def note(self, name: Name, entry: Entry, template: ApplicationTemplate | InvalidTemplate | None) -> set[Name]:
        """Note a task as it is now; returns the instances that it claimed or claims."""
        before = self._claims.get(name)
        touched = self.forget(name)
        task = entry.model
        if not isinstance(task, ApplicationTask):
            problem = f"{entry.problem}: correct the task, or delete it and create another"
            self._verdicts[name] = Verdict(Standing.REFUSED, Refused.INVALID_TASK, problem)
            return touched
        of = (name[0], task.spec.template)
        self._templates[name] = of
        self._by_template.setdefault(of, {})[name] = task
        claimed = claim_or_verdict(template, task)
        if isinstance(claimed, Verdict):
            served = before is not None and template_of_all(before.instance) is None
            if claimed.standing is Standing.FINISHED and before is not None and served:  # its status may not say so yet
                claimed = replace(claimed, instance=before.instance)
            self._verdicts[name] = claimed
            return touched
        instance = (name[0], claimed.instance)
        self._claims[name] = claimed
        self._by_instance.setdefault(instance, {})[name] = claimed
        return touched | {instance}

    def forget(self, name: Name) -> set[Name]:
        """Forget a task; returns the instances that it claimed."""
        self._verdicts.pop(name, None)
        of = self._templates.pop(name, None)
        if of is not None:
            _discard(self._by_template, of, name)
        claimed = self._claims.pop(name, None)
        if claimed is None:
            return set()
        instance = (name[0], claimed.instance)
        _discard(self._by_instance, instance, name)
        return {instance}

    def verdict(self, name: Name) -> Verdict | None:
        """The verdict of a task that claims nothing."""
        return self._verdicts.get(name)

    def claim(self, name: Name) -> Claim | None:
        """The claim of a task."""
        return self._claims.get(name)

    def claims(self, instance: Name, template: str | None = None) -> list[Claim]:
        """All claims on an instance; with its template, also those on all instances of that."""
        claimed = list(self._by_instance.get(instance, {}).values())
        if template is not None:
            claimed += self._by_instance.get((instance[0], all_instances(template)), {}).values()
        return claimed

    def claimed_of(self, template: Name) -> set[Name]:
        """The instances of a template that tasks claim; what stands for all of them is none."""
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


def _discard(
    index: dict[Name, dict[Name, Claim]] | dict[Name, dict[Name, ApplicationTask]], at: Name, of: Name
) -> None:
    members = index.get(at)
    if members is not None:
        members.pop(of, None)
        if not members:
            del index[at]
