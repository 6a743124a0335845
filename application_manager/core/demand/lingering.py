"""The lifetime of an instance: its linger, its minUptime, and the annotations of people. Pure.

An annotation counts if it is present, whatever its value, which may name its author and the reason; only the value
`false` counts as absent. Both annotations have a condition in the instance's status, which is False after the
annotation was removed.
"""

from __future__ import annotations

from collections.abc import Iterator

from application_manager.core.claims.claims import TemplateState
from application_manager.core.conditions import ConditionState, from_first
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.api.applicationtemplate import Lifecycle
from wayside.api.base import Duration
from wayside.times import parse_seconds

LINGER_ANNOTATION = "wayside.dev/linger"
"""On an instance: its template's linger, for the case that the template is deleted."""


PAUSE_ANNOTATION = "wayside.dev/pause"
"""On an instance: the manager does not change, prune or release it or its objects."""

HOLD_ANNOTATION = "wayside.dev/hold"
"""On an instance: it is not released without demand. Demands are still served."""

_CONDITIONS = (
    ("Paused", PAUSE_ANNOTATION, "the instance and its objects are not changed"),
    ("Held", HOLD_ANNOTATION, "the instance is kept, with or without demand"),
)
_BARE = frozenset({"", "true"})  # values without a reason


def written_deadline(instance: ApplicationInstance) -> float | None:
    """The release time in the status, in seconds since 1970: it survives our own restart."""
    written = instance.status.release_time if instance.status else None
    return None if written is None else parse_seconds(written)


def linger_of(instance: ApplicationInstance, template: ApplicationTemplate | None) -> Duration:
    """How long the instance lingers: by its template or, if that is deleted, by the annotation."""
    if template is not None:
        return template.spec.lifecycle.linger
    noted = instance.metadata.annotations.get(LINGER_ANNOTATION)
    try:
        return Duration.parse(noted) if noted else Lifecycle().linger
    except ValueError:
        return Lifecycle().linger  # a person wrote another value into the annotation


def protected_until(instance: ApplicationInstance, template: TemplateState) -> float:
    """The end of the instance's minUptime, in seconds since 1970; 0 if its template has none."""
    if not isinstance(template, ApplicationTemplate) or not instance.metadata.creation_timestamp:
        return 0.0
    uptime = template.spec.lifecycle.min_uptime.seconds
    return parse_seconds(instance.metadata.creation_timestamp) + uptime if uptime else 0.0


def is_paused(instance: ApplicationInstance) -> bool:
    """Whether a person paused the instance."""
    return _reason(instance, PAUSE_ANNOTATION) is not None


def is_held(instance: ApplicationInstance) -> bool:
    """Whether a person holds the instance."""
    return _reason(instance, HOLD_ANNOTATION) is not None


def manual_conditions(instance: ApplicationInstance) -> Iterator[ConditionState]:
    """The conditions Paused and Held: True with the annotation, False after it was removed, absent before."""
    known = instance.status.conditions if instance.status else ()
    for type_, annotation, meaning in _CONDITIONS:
        reason = _reason(instance, annotation)
        why = "" if reason in _BARE else f" ({reason})"
        message = f"{meaning} until the annotation {annotation} is removed{why}"
        now = (f"{type_}ByAnnotation", message) if reason is not None else None
        yield from from_first(known, type_, now, (f"Not{type_}", f"there is no annotation {annotation}"))


def _reason(instance: ApplicationInstance, annotation: str) -> str | None:
    value = instance.metadata.annotations.get(annotation)
    return None if value is None or value.strip().lower() == "false" else value.strip()
