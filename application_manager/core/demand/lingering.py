"""How long an instance stays: its linger, once nobody demands it, its minimumUptime, and what people want. Pure.

An annotation of a person counts by being there, whatever its value, which may name who wants it and why; only `false`
is as if it were absent. Both are conditions of the instance's status while they hold, and are False once it is gone.
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
"""On an instance: its template's linger, for when the template is gone."""


PAUSE_ANNOTATION = "wayside.dev/pause"
"""On an instance: neither it nor its objects are changed, pruned or released."""

HOLD_ANNOTATION = "wayside.dev/hold"
"""On an instance: it is not released though nobody demands it. Demands that come are served as ever."""

_CONDITIONS = (
    ("Paused", PAUSE_ANNOTATION, "the instance and its objects are not changed"),
    ("Held", HOLD_ANNOTATION, "the instance is kept, with or without demand"),
)
_BARE = frozenset({"", "true"})  # values without a reason


def written_deadline(instance: ApplicationInstance) -> float | None:
    """The release time that the status holds, in seconds since 1970: what survives our own restart."""
    written = instance.status.release_time if instance.status else None
    return None if written is None else parse_seconds(written)


def linger_of(instance: ApplicationInstance, template: ApplicationTemplate | None) -> Duration:
    """How long the instance lingers: by its template, or by what that had while there was one."""
    if template is not None:
        return template.spec.lifecycle.linger
    noted = instance.metadata.annotations.get(LINGER_ANNOTATION)
    try:
        return Duration.parse(noted) if noted else Lifecycle().linger
    except ValueError:
        return Lifecycle().linger  # somebody wrote something else into the annotation


def protected_until(instance: ApplicationInstance, template: TemplateState) -> float:
    """When the instance has been there for its template's minimumUptime, in seconds since 1970; 0 where it has none."""
    if not isinstance(template, ApplicationTemplate) or not instance.metadata.creation_timestamp:
        return 0.0
    uptime = template.spec.lifecycle.minimum_uptime.seconds
    return parse_seconds(instance.metadata.creation_timestamp) + uptime if uptime else 0.0


def is_paused(instance: ApplicationInstance) -> bool:
    """Whether the instance is to be left as it is."""
    return _reason(instance, PAUSE_ANNOTATION) is not None


def is_held(instance: ApplicationInstance) -> bool:
    """Whether the instance is to be kept though nobody demands it."""
    return _reason(instance, HOLD_ANNOTATION) is not None


def manual_conditions(instance: ApplicationInstance) -> Iterator[ConditionState]:
    """The conditions Paused and Held: True while the annotation is there, False once it is gone, absent before."""
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
