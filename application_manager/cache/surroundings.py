"""What a rule is judged with: what the cache has beside it in its namespace."""

from __future__ import annotations

from typing import Any

from application_manager.cache.cluster_cache import DETECTOR, EVENT_RULE, TEMPLATE, ClusterCache
from application_manager.workers.jobs import RuleContext
from wayside.api import ApplicationTemplate, Detector, EventRule
from wayside.rules import depends


def surroundings(cache: ClusterCache, rule: EventRule) -> RuleContext:
    """As far as they matter to the rule: other rules where it names any, templates where it deploys."""
    namespace = rule.namespace
    deploys = any(each.deploy is not None for each in rule.spec.actions)
    return RuleContext(
        detectors=cache.models(DETECTOR, Detector, namespace),
        invalid_detectors=cache.invalid(DETECTOR, namespace),
        rules=cache.models(EVENT_RULE, EventRule, namespace) if depends(rule) else [],
        templates=[_bare(each) for each in cache.models(TEMPLATE, ApplicationTemplate, namespace)] if deploys else [],
        invalid_templates=cache.invalid(TEMPLATE, namespace) if deploys else [],
    )


def _bare(template: ApplicationTemplate) -> ApplicationTemplate:
    """The template without its objects, which may be large: a rule gives parameters alone."""
    less: dict[str, Any] = {"manifests": [], "configuration": {}, "helm": None}
    return template.model_copy(update={"spec": template.spec.model_copy(update=less), "status": None})
