"""The deploy action: an application is demanded for as long as an episode lasts."""

from __future__ import annotations

from pydantic import Field

from wayside.api.base import Identifier, JsonValue, Model, TemplateName
from wayside.api.operation import MEANING, Operation


class Deploy(Model):
    """Demand, reconfigure or suspend an application for as long as the episode lasts."""

    template: TemplateName = Field(description="The ApplicationTemplate, in the rule's namespace.")
    operation: Operation = Field(default=Operation.DEPLOY, description=MEANING)
    priority: int = Field(
        default=0, ge=-1_000_000, le=1_000_000, description="Tasks of higher priority are looked at first."
    )
    parameters: dict[Identifier, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="The template's parameters, with ${…} over the rule's variables at the start of the episode.",
    )
    follow: bool = Field(
        default=False,
        description="true: the parameters are evaluated again at each evaluation while the episode lasts, and the task "
        "is patched when they change. One that is unknown or fails keeps its last value.",
    )
