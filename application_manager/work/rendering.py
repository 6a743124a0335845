"""Renders the objects of instances in worker processes; small templates that only read fields, in this process.

A missing result is requested, and the instance is enqueued once it is available. A rendering that exceeds its limits is
an error of its template, whose status reports it; the instance's objects stay unchanged.
"""

from __future__ import annotations

import pickle
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.claims.claims import TemplateState
from application_manager.core.conditions import ConditionState
from application_manager.core.demand import drafting
from application_manager.core.objects.charts import ChartOutcome, ChartRequest, Charts
from application_manager.core.objects.ownership import ApplyProblem
from application_manager.core.objects.policy import Name
from application_manager.core.objects.rendering import Rendering
from application_manager.workers.answers import AnswerCache, Exceeded
from application_manager.workers.jobs import objects_are_plain, render_instance, values_are_small
from application_manager.workers.process import Job
from wayside.api import ApplicationInstance, ApplicationTemplate

_PICKLED = 64  # templates to keep as bytes
_JUDGED = 1024  # templates whose result of `objects_are_plain` is kept

Value = TypeVar("Value")
_OfTemplates = OrderedDict[tuple[str, int], Value]  # by uid and generation


class Renderings:
    """Renders instances in the background. Only the event loop's thread uses it."""

    def __init__(
        self,
        cache: ClusterCache,
        answers: AnswerCache,
        charts: Charts,
        enqueue: Callable[[Name], None],
        template_changed: Callable[[Name], None],
    ) -> None:
        """`enqueue` enqueues an instance, `template_changed` one that now exceeds the limits, or no longer does."""
        self._cache = cache
        self._answers = answers
        self._charts = charts
        self._enqueue = enqueue
        self._template_changed = template_changed
        self._pickled: _OfTemplates[bytes] = OrderedDict()
        self._plain: _OfTemplates[bool] = OrderedDict()

    def objects(self, desired: ApplicationInstance, template: TemplateState) -> Rendering | ConditionState | None:
        """The instance's objects, or the condition Applied if it has none; None: not available yet."""
        problem = drafting.without_template(desired, template)
        if problem is not None or not isinstance(template, ApplicationTemplate):
            return problem
        found = self._answer("rendering", desired, template, None)
        if isinstance(found, ChartRequest):
            outcome = self._charts(found)
            if outcome is None:
                return drafting.chart_pending(template, found)
            if isinstance(outcome, ApplyProblem):
                return drafting.problem(template, outcome.reason, outcome.message)
            found = self._answer("chart", desired, template, outcome)
        name = (desired.namespace, desired.name)
        self._note(name, (template.namespace, template.name), found)
        match found:
            case Rendering():
                return found
            case ApplyProblem(reason, message):
                return drafting.problem(template, reason, message)
            case Exceeded(message):
                return drafting.problem(template, drafting.EXPRESSION_LIMIT, f"rendering this instance {message}")
        return None

    def forget(self, name: Name) -> None:
        """Forget an instance that was deleted."""
        for kind in ("rendering", "chart"):
            self._answers.forget((kind, *name))
        for template in [each for each, instances in self._cache.exceeded.items() if name in instances]:
            self._note(name, template, ApplyProblem("", ""))

    def _answer(
        self, kind: str, desired: ApplicationInstance, template: ApplicationTemplate, chart: ChartOutcome | None
    ) -> object | None:
        name = (desired.namespace, desired.name)
        metadata = template.metadata
        bare = desired.model_copy(update={"status": None})

        def job() -> Job[object]:
            written = _kept(self._pickled, template, _pickled, _PICKLED)
            return partial(render_instance, written, self._cache.policy, bare, chart)

        if _kept(self._plain, template, objects_are_plain, _JUDGED) and values_are_small(bare):
            return job()()
        return self._answers.answer(
            key=(kind, *name),
            question=(metadata.uid, metadata.generation, desired.spec, chart),
            namespace=desired.namespace,
            job=job,
            done=partial(self._enqueue, name),
        )

    def _note(self, name: Name, template: Name, found: object | None) -> None:
        """Note whether the instance's rendering exceeds the limits; nothing while it is being computed."""
        if found is None:
            return
        before = self._cache.exceeded.get(template, {}).get(name)
        after = found.message if isinstance(found, Exceeded) else None
        if before == after:
            return
        if after is None:
            self._cache.exceeded.drop(template, name)
        else:
            self._cache.exceeded.put(template, name, after)
        self._template_changed(template)


def _kept(
    known: _OfTemplates[Value], template: ApplicationTemplate, make: Callable[[ApplicationTemplate], Value], most: int
) -> Value:
    """The state of the template, created if it is missing; the least recently used ones are forgotten."""
    key = (template.metadata.uid, template.metadata.generation)
    if key not in known:
        known[key] = make(template)
        if len(known) > most:
            known.popitem(last=False)
    known.move_to_end(key)
    return known[key]


def _pickled(template: ApplicationTemplate) -> bytes:
    return pickle.dumps(template.model_copy(update={"status": None}), pickle.HIGHEST_PROTOCOL)
