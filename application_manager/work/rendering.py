"""Renders the objects of instances in worker processes; those of small templates that only read, in this one.

What is not there yet is requested, and the instance enqueued once it is. A rendering that takes too much is a
problem of its template, whose status gives it; what runs of the instance stays as it is.
"""

from __future__ import annotations

import pickle
from collections import OrderedDict
from collections.abc import Callable
from functools import partial

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.claims.claims import TemplateState
from application_manager.core.conditions import Aspect
from application_manager.core.demand import drafting
from application_manager.core.objects.charts import ChartFailure, ChartOutcome, ChartRequest, Charts
from application_manager.core.objects.policy import Name
from application_manager.core.objects.rendering import Rendering
from application_manager.workers.answers import AnswerCache, Exceeded
from application_manager.workers.jobs import RenderProblem, objects_are_plain, render, values_are_small
from application_manager.workers.process import Job
from wayside.api import ApplicationInstance, ApplicationTemplate

_PICKLED = 64  # templates that are kept as bytes
_JUDGED = 1024  # templates of which is known whether they are plain


class Renderings:
    """Renders charts in the background. Only the event loop's thread uses it."""

    def __init__(
        self,
        cache: ClusterCache,
        answers: AnswerCache,
        charts: Charts,
        again: Callable[[Name], None],
        template_changed: Callable[[Name], None],
    ) -> None:
        """`again` enqueues an instance, `template_changed` a template whose renderings exceed the limit, or no more."""
        self._cache = cache
        self._answers = answers
        self._charts = charts
        self._again = again
        self._template_changed = template_changed
        self._pickled: OrderedDict[tuple[str, int], bytes] = OrderedDict()
        self._plain: OrderedDict[tuple[str, int], bool] = OrderedDict()

    def objects(self, wanted: ApplicationInstance, template: TemplateState) -> Rendering | Aspect | None:
        """The instance's objects, or why it has none, as the condition Applied gives it; None: it is enqueued later."""
        problem = drafting.without_template(wanted, template)
        if problem is not None or not isinstance(template, ApplicationTemplate):
            return problem
        found = self._answer("rendering", wanted, template, None)
        if isinstance(found, ChartRequest):
            outcome = self._charts(found)
            if outcome is None:
                return drafting.chart_pending(template, found)
            if isinstance(outcome, ChartFailure):
                return drafting.problem(template, outcome.reason, outcome.message)
            found = self._answer("chart", wanted, template, outcome)
        name = (wanted.namespace, wanted.name)
        self._note(name, (template.namespace, template.name), found)
        match found:
            case Rendering():
                return found
            case RenderProblem(reason, message):
                return drafting.problem(template, reason, message)
            case Exceeded(message):
                return drafting.problem(template, drafting.EXPRESSION_LIMIT, f"rendering this instance {message}")
        return None

    def forget(self, name: Name) -> None:
        """Drop what is known of an instance that is deleted."""
        for kind in ("rendering", "chart"):
            self._answers.forget((kind, *name))
        for template in [each for each, instances in self._cache.exceeded.items() if name in instances]:
            self._note(name, template, RenderProblem("", ""))

    def _answer(
        self, kind: str, wanted: ApplicationInstance, template: ApplicationTemplate, chart: ChartOutcome | None
    ) -> object | None:
        name = (wanted.namespace, wanted.name)
        metadata = template.metadata
        bare = wanted.model_copy(update={"status": None})

        def job() -> Job[object]:
            return partial(render, self._bytes(template), self._cache.policy, bare, chart)

        if self._is_plain(template) and values_are_small(bare):
            return job()()
        return self._answers.answer(
            key=(kind, *name),
            question=(metadata.uid, metadata.generation, wanted.spec, chart),
            namespace=wanted.namespace,
            job=job,
            done=partial(self._again, name),
        )

    def _is_plain(self, template: ApplicationTemplate) -> bool:
        key = (template.metadata.uid, template.metadata.generation)
        if key not in self._plain:
            self._plain[key] = objects_are_plain(template)
            while len(self._plain) > _JUDGED:
                self._plain.popitem(last=False)
        return self._plain[key]

    def _bytes(self, template: ApplicationTemplate) -> bytes:
        key = (template.metadata.uid, template.metadata.generation)
        known = self._pickled.get(key)
        if known is None:
            bare = template.model_copy(update={"status": None})
            known = self._pickled[key] = pickle.dumps(bare, pickle.HIGHEST_PROTOCOL)
            while len(self._pickled) > _PICKLED:
                self._pickled.popitem(last=False)
        self._pickled.move_to_end(key)
        return known

    def _note(self, name: Name, template: Name, found: object | None) -> None:
        """Note whether the instance's rendering exceeds the limit; nothing while it is being computed."""
        if found is None:
            return
        known = self._cache.exceeded.get(template, {})
        before = known.get(name)
        after = found.message if isinstance(found, Exceeded) else None
        if before == after:
            return
        if after is None:
            del known[name]
            if not known:
                del self._cache.exceeded[template]
        else:
            self._cache.exceeded.setdefault(template, {})[name] = after
        self._template_changed(template)
