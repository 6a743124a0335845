"""How long an instance stays: its linger, once nobody demands it, and its minimumUptime. Pure."""

from __future__ import annotations

from application_manager.core.claims.claims import InvalidTemplate
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.api.applicationtemplate import Lifecycle
from wayside.api.base import Duration
from wayside.times import parse_seconds

LINGER_ANNOTATION = "wayside.dev/linger"
"""On an instance: its template's linger, for when the template is gone."""


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


def protected_until(instance: ApplicationInstance, template: ApplicationTemplate | InvalidTemplate | None) -> float:
    """When the instance has been there for its template's minimumUptime, in seconds since 1970; 0 where it has none."""
    if not isinstance(template, ApplicationTemplate) or not instance.metadata.creation_timestamp:
        return 0.0
    uptime = template.spec.lifecycle.minimum_uptime.seconds
    return parse_seconds(instance.metadata.creation_timestamp) + uptime if uptime else 0.0
