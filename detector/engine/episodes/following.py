"""Parameters of actions with `follow`: evaluated again at each evaluation of the episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from detector.engine.counters import RuleCounters
from wayside.api.base import JsonValue
from wayside.expressions import InterpolationError
from wayside.rules import CompiledDeploy


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
