"""The templates of actions, rendered with the variables of a rule when an episode starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from wayside.api.base import JsonValue
from wayside.expressions import InterpolationError
from wayside.rules import CompiledAction


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
