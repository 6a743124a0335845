"""Drafts an instance from a decision: its spec, its manifest and its objects. Pure."""

from __future__ import annotations

from typing import Any

from application_manager.core.claims.claims import InvalidTemplate, TemplateState
from application_manager.core.conditions import ConditionState
from application_manager.core.demand.decisions import Decision, is_managed
from application_manager.core.demand.lingering import LINGER_ANNOTATION, linger_of
from application_manager.core.objects.charts import ChartRequest
from application_manager.core.objects.policy import Name
from wayside.api import API_VERSION, ApplicationInstance, ApplicationTemplate
from wayside.api.applicationinstance import ApplicationInstanceSpec
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL, Metadata


def draft(name: Name, decision: Decision, existing: ApplicationInstance | None) -> ApplicationInstance:
    """The instance as it should be; without a uid if it does not exist yet."""
    suspended = bool(existing and existing.spec.suspended) if decision.suspended is None else decision.suspended
    if existing is not None and decision.parameters is None:
        if suspended == existing.spec.suspended:
            return existing
        return existing.model_copy(update={"spec": existing.spec.model_copy(update={"suspended": suspended})})
    spec = ApplicationInstanceSpec(
        template_name=decision.template,
        key=decision.key,
        parameters=dict(decision.parameters or {}),
        suspended=suspended,
    )
    if existing is not None:
        return existing.model_copy(update={"spec": spec})
    labels = {MANAGED_BY_LABEL: MANAGED_BY}
    return ApplicationInstance(metadata=Metadata(name=name[1], namespace=name[0], labels=labels), spec=spec)


def manifest(
    desired: ApplicationInstance, existing: ApplicationInstance | None, template: TemplateState
) -> dict[str, Any] | None:
    """The manifest that changes the instance to the desired one; None if they are equal, or a person created it."""
    usable = template if isinstance(template, ApplicationTemplate) else None
    if existing is None:
        return created(desired, usable)
    linger = str(linger_of(desired, usable))
    noted = existing.metadata.annotations.get(LINGER_ANNOTATION)
    if not is_managed(existing) or (existing.spec == desired.spec and (usable is None or noted == linger)):
        return None
    whole = created(desired, usable)
    return {**whole, "metadata": {**whole["metadata"], "uid": existing.metadata.uid}}


def created(desired: ApplicationInstance, template: ApplicationTemplate | None) -> dict[str, Any]:
    """The manifest to create the instance with."""
    return {
        "apiVersion": API_VERSION,
        "kind": desired.kind,
        "metadata": {
            "name": desired.name,
            "namespace": desired.namespace,
            "labels": {MANAGED_BY_LABEL: MANAGED_BY},
            "annotations": {LINGER_ANNOTATION: str(linger_of(desired, template))},
        },
        "spec": desired.spec.to_json(),
    }


CHART_PENDING = "ChartPending"
"""The reason of the condition Applied while a chart is being rendered."""


EXPRESSION_LIMIT = "ExpressionLimit"
"""The reason of the condition Applied if the expressions of the template exceed their limits."""


def without_template(desired: ApplicationInstance, template: TemplateState) -> ConditionState | None:
    """The condition Applied of an instance without objects, if its template is missing or invalid."""
    of = desired.spec.template_name
    if template is None:
        message = (
            f"spec.templateName: there is no ApplicationTemplate {of!r} in namespace {desired.namespace}: create "
            "it; until then, the running objects are not changed"
        )
        return ConditionState("Applied", False, "TemplateNotFound", message)
    if isinstance(template, InvalidTemplate):
        return ConditionState("Applied", False, "TemplateInvalid", f"ApplicationTemplate {of}: {template.problem}")
    return None


def problem(template: ApplicationTemplate, reason: str, message: str) -> ConditionState:
    """The condition Applied of an instance that cannot be rendered."""
    return ConditionState("Applied", False, reason, f"ApplicationTemplate {template.name}: {message}")


def chart_pending(template: ApplicationTemplate, request: ChartRequest) -> ConditionState:
    """The condition Applied while the instance's chart is being rendered."""
    return problem(template, CHART_PENDING, f"chart {request.source} is being rendered")
