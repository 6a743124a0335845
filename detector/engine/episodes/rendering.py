"""The templates of actions, rendered with the variables of a rule: at the start of an episode; `follow` also later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from detector.engine.counters import RuleCounters
from wayside.api.base import JsonValue
from wayside.expressions import InterpolationError
from wayside.rules import CompiledAction, CompiledDeploy


@dataclass(frozen=True, slots=True)
class Rendered:
    """An action's templates by name: the rendered texts, and for the others the reason why rendering failed."""

    values: Mapping[str, JsonValue] = field(default_factory=dict)
    problems: Mapping[str, str] = field(default_factory=dict)


def render_templates(action: CompiledAction, variables: Mapping[str, Any] | None) -> Rendered:
    """Render each template separately; `variables` is None if the episode was restored after a restart."""
    values: dict[str, JsonValue] = {}
    problems: dict[str, str] = {}
    for name, template in action.templates.items():
        if variables is None:
            problems[name] = "it needs values from before the detector's restart"
            continue
        try:
            rendered = template.render(variables)
        except InterpolationError as error:
            problems[name] = str(error)
        else:
            values |= rendered if isinstance(rendered, dict) else {}  # a null key or value is dropped
    return Rendered(values, problems)


def followed(
    deploy: CompiledDeploy,
    subject: str,
    before: Mapping[str, JsonValue],
    variables: Mapping[str, Any],
    counters: RuleCounters,
) -> dict[str, JsonValue]:
    """The current parameters of the action.

    Each parameter is evaluated separately: one that is unknown or fails keeps its value in `before`, and is counted.
    Null ones are left out, as at the start.
    """
    now: dict[str, JsonValue] = {}
    for name, template in deploy.each_parameter.items():
        try:
            value = template.render(variables)
        except InterpolationError as error:
            counters.unfollowed += 1
            counters.last_unfollowed = f"action {deploy.action} of {subject}: {error}"
            if name in before:
                now[name] = before[name]
        else:
            if value is not None:
                now[name] = value
    return now
